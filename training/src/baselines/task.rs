//! What a method is judged on.

use std::ops::Range;
use std::path::PathBuf;

use grnet_geometry::Pose;

/// One frame of a recording.
#[derive(Debug, Clone, PartialEq)]
pub struct View {
    /// The image.
    pub image: PathBuf,
    /// Which sequence it belongs to; frames of different sequences are never neighbours.
    pub sequence: usize,
    /// Its index in the whole sequence, whatever list chose it; neighbours differ by 1.
    pub index: u64,
    /// Time of capture in nanoseconds on the recording's clock.
    pub time_ns: u64,
    /// The true pose, metres; `None` where the recording does not know it.
    pub world_from_camera: Option<Pose>,
}

/// Frames to learn from and frames to be judged on.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Task {
    /// In order of sequence and index; frames without a pose teach nothing and are left out by [`Task::new`].
    pub train: Vec<View>,
    /// In order of sequence and index.
    pub test: Vec<View>,
}

impl Task {
    /// Sorts the frames and leaves out training frames without a pose.
    pub fn new(mut train: Vec<View>, mut test: Vec<View>) -> Self {
        train.retain(|view| view.world_from_camera.is_some());
        for views in [&mut train, &mut test] {
            views.sort_by_key(|view| (view.sequence, view.index));
        }
        Self { train, test }
    }

    /// Training poses and the frames they belong to.
    pub fn train_poses(&self) -> impl Iterator<Item = (&View, Pose)> {
        self.train.iter().filter_map(|view| Some((view, view.world_from_camera?)))
    }

    /// Runs of neighbours among the test frames: recurrent state is reset on the first frame of each, and no
    /// method carries anything from one to the next.
    pub fn blocks(&self) -> Vec<Range<usize>> {
        let neighbours = |a: &View, b: &View| a.sequence == b.sequence && a.index + 1 == b.index;
        let mut start = 0;
        let ranges = self.test.chunk_by(neighbours).map(|block| {
            let range = start..start + block.len();
            start = range.end;
            range
        });
        ranges.collect()
    }

    /// Test frames `(i, j)` of one block with `j = i + gap`.
    pub fn pairs(&self, gap: usize) -> Vec<(usize, usize)> {
        let pairs =
            |block: Range<usize>| (block.start..block.end.saturating_sub(gap)).map(move |i| (i, i + gap));
        self.blocks().into_iter().flat_map(pairs).collect()
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// A frame at `x` metres, turned by `yaw_deg`.
    pub fn view(sequence: usize, index: u64, x: f64, yaw_deg: f64) -> View {
        let pose = Pose::new(
            nalgebra::Vector3::new(x, 0.0, 0.0),
            nalgebra::Vector3::new(0.0, yaw_deg.to_radians(), 0.0),
        );
        View {
            image: format!("no-such-image-{sequence}-{index}.png").into(),
            sequence,
            index,
            time_ns: index * 33_333_333,
            world_from_camera: Some(pose),
        }
    }

    #[test]
    fn blocks_end_where_frames_or_sequences_do() {
        let test = [(1, 0), (0, 5), (0, 6), (0, 8), (1, 1)].map(|(s, i)| view(s, i, 0.0, 0.0));
        let task = Task::new(vec![], test.to_vec());
        assert_eq!(task.blocks(), vec![0..2, 2..3, 3..5]);
        assert_eq!(task.pairs(1), vec![(0, 1), (3, 4)]);
        assert_eq!(task.pairs(2), vec![]);
        assert!(Task::default().blocks().is_empty());
    }

    #[test]
    fn training_frames_without_a_pose_are_left_out() {
        let lost = View { world_from_camera: None, ..view(0, 1, 0.0, 0.0) };
        let task = Task::new(vec![view(0, 2, 0.0, 0.0), lost.clone()], vec![lost]);
        assert_eq!((task.train.len(), task.test.len()), (1, 1));
    }
}
