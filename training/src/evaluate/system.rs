//! One output to be judged: of a baseline, or one of those of a model.

use grnet_geometry::{Covariance6, Pose, se3};
use serde::{Deserialize, Serialize};

use crate::baselines::{Predictions, Task};

/// What a system is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// What has to be beaten.
    Baseline,
    /// The pose of FCFL, before any gate.
    Fused,
    /// The pose of RCNN2 alone.
    Global,
    /// What the daemon publishes as the pose in the map: the network's, gated by the odometry.
    Published,
    /// The integrated motion of RCNN1.
    Odometry,
}

/// What of the test frames' truth a system is told.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Knowledge {
    /// Nothing: its figures are what a robot would get.
    None,
    /// Where each block begins, as odometry has to be told.
    FirstPose,
    /// Between which training frames each frame was taken; it looks at no image.
    FrameNumbers,
    /// More than any method may know: a bound, not a competitor.
    Truth,
}

/// Predictions for the test frames and where they come from.
#[derive(Debug, Clone)]
pub struct System {
    /// What tables call it.
    pub name: String,
    /// Its folder's name in the report: letters, digits and hyphens.
    pub slug: String,
    /// What it is.
    pub kind: Kind,
    /// What it is told.
    pub knowledge: Knowledge,
    /// One sentence for readers.
    pub about: String,
    /// Index of its model in the evaluation.
    pub model: Option<usize>,
    /// `world_from_camera` of every test frame; `None` for a system that predicts motion only.
    pub poses: Option<Predictions>,
    /// `earlier_from_current` over the gap, for a system that predicts motion only.
    pub motions: Option<Predictions>,
    /// Covariance of each pose, [translation, rotation] about the world's axes; NaN where unknown, empty where the
    /// system has none.
    pub covariances: Vec<Covariance6>,
}

impl System {
    /// A system without covariances that is told nothing.
    pub fn new(name: &str, kind: Kind, about: &str) -> Self {
        Self {
            name: name.into(),
            slug: slug(name),
            kind,
            knowledge: Knowledge::None,
            about: about.into(),
            model: None,
            poses: None,
            motions: None,
            covariances: Vec::new(),
        }
    }

    /// Whether it belongs to a model.
    pub fn is_model(&self) -> bool {
        self.kind != Kind::Baseline
    }

    /// Predicted pose of a test frame.
    pub fn pose(&self, frame: usize) -> Option<Pose> {
        self.poses.as_ref()?[frame]
    }

    /// Predicted motion between the test frames of each pair, `earlier_from_current`.
    pub fn motion(&self, (earlier, current): (usize, usize)) -> Option<Pose> {
        match &self.motions {
            Some(motions) => motions[current],
            None => Some(se3::relative(&self.pose(earlier)?, &self.pose(current)?)),
        }
    }

    /// Number of test frames with a true pose for which it has a pose as well.
    pub fn valid(&self, task: &Task) -> usize {
        let truths = task.test.iter().enumerate().filter(|(_, view)| view.world_from_camera.is_some());
        truths.filter(|(frame, _)| self.pose(*frame).is_some()).count()
    }
}

/// Lower-case letters, digits and single hyphens.
pub fn slug(name: &str) -> String {
    let mapped: String =
        name.chars().map(|c| if c.is_ascii_alphanumeric() { c.to_ascii_lowercase() } else { '-' }).collect();
    mapped.split('-').filter(|part| !part.is_empty()).collect::<Vec<_>>().join("-")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slugs_are_safe_file_names() {
        assert_eq!(slug("My Model (v2) / fused"), "my-model-v2-fused");
        assert_eq!(slug("../../etc"), "etc");
    }
}
