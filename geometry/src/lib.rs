//! Rigid-body poses, trajectories, alignment and scores
