//! Training, evaluation and the synthetic scene
