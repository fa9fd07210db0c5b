//! The global-relative network (CNN1, RCNN1, RCNN2, FCFL) on candle
