//! Scores of estimated trajectories.
