//! step(frame) -> estimate: preprocess, infer, fuse
