//! The recording to judge on: which frames are trained on, which are tested.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use grnet_capture::dataset::{self, Layout, OpenOptions, Recording, Split};
use nalgebra::Vector3;

use super::EvaluateError;
use crate::baselines::{Task, View};

/// Where the recording is and which of its frames to take.
#[derive(Debug, Clone, Default)]
pub struct DataOptions {
    /// Layout, sequence, camera, rate, poses; its `split` is not looked at.
    pub open: OpenOptions,
    /// List of the frames to learn from; without one the official training split, where there is one.
    pub train_list: Option<PathBuf>,
    /// List of the frames to be judged on; without one the official test split, or all frames.
    pub test_list: Option<PathBuf>,
}

/// An opened recording.
#[derive(Debug, Clone)]
pub struct Data {
    /// The recording's folder.
    pub path: PathBuf,
    /// Every sequence with all of its frames; [`View::sequence`] is an index into this.
    pub recordings: Vec<Recording>,
    /// The frames to learn from and to be judged on.
    pub task: Task,
    /// What a reader of the report should know about the recording.
    pub notes: Vec<String>,
}

impl Data {
    /// Opens the recording at `path`.
    ///
    /// # Errors
    /// When it cannot be opened, a frame is both trained and tested on, or no test frame has a true pose.
    pub fn open(path: &Path, options: &DataOptions) -> Result<Self, EvaluateError> {
        let open = |split| dataset::open(path, &OpenOptions { split, ..options.open.clone() });
        let recordings = open(Split::All)?;
        let mut places = HashMap::new();
        for (sequence, recording) in recordings.iter().enumerate() {
            for (index, frame) in recording.frames.iter().enumerate() {
                places.insert(frame.path.clone(), (sequence, index as u64));
            }
        }
        let views = |split| -> Result<Vec<View>, EvaluateError> {
            let chosen = if split == Split::All { recordings.clone() } else { open(split)? };
            let frames = chosen.into_iter().flat_map(|recording| recording.frames);
            let view = |frame: dataset::RecordedFrame| {
                let &(sequence, index) = places.get(&frame.path)?;
                let (time_ns, world_from_camera) = (frame.time_ns, frame.world_from_camera);
                Some(View { image: frame.path, sequence, index, time_ns, world_from_camera })
            };
            Ok(frames.filter_map(view).collect())
        };
        let official = recordings[0].layout == Layout::SevenScenes;
        let test = match &options.test_list {
            Some(list) => Split::List(list.clone()),
            None if official && lists_something(&path.join("TestSplit.txt")) => Split::Test,
            None => Split::All,
        };
        let train = match &options.train_list {
            Some(list) => views(Split::List(list.clone()))?,
            // A pass that is for testing alone has an empty list.
            None if test == Split::Test && lists_something(&path.join("TrainSplit.txt")) => {
                views(Split::Train)?
            }
            None => Vec::new(),
        };
        let mut notes: Vec<String> =
            recordings.iter().flat_map(|recording| recording.notes.clone()).collect();
        notes.dedup();
        let task = Task::new(train, views(test)?);
        check(path, &task)?;
        Ok(Self { path: path.to_path_buf(), recordings, task, notes })
    }

    /// The test frames of one sequence, as a range of [`Task::test`].
    pub fn test_range(&self, sequence: usize) -> std::ops::Range<usize> {
        let at = |s| self.task.test.partition_point(|view| view.sequence < s);
        at(sequence)..at(sequence + 1)
    }

    /// Sequences that have test frames.
    pub fn tested_sequences(&self) -> Vec<usize> {
        (0..self.recordings.len()).filter(|s| !self.test_range(*s).is_empty()).collect()
    }

    /// The axis of the world (0, 1, 2) that is nearest to the vertical, judged by how cameras are held: their y axis
    /// points down on the average.
    pub fn vertical_axis(&self) -> usize {
        let poses = self.task.test.iter().filter_map(|view| view.world_from_camera);
        let down: Vector3<f64> = poses.map(|pose| pose.rotation * Vector3::y()).sum();
        down.iamax()
    }
}

fn lists_something(split: &Path) -> bool {
    std::fs::read_to_string(split).is_ok_and(|text| !text.trim().is_empty())
}

fn check(path: &Path, task: &Task) -> Result<(), EvaluateError> {
    let trained: std::collections::HashSet<_> = task.train.iter().map(|view| &view.image).collect();
    let both: Vec<_> = task.test.iter().filter(|view| trained.contains(&view.image)).collect();
    if let Some(first) = both.first() {
        return Err(EvaluateError::Overlap { count: both.len(), example: first.image.clone() });
    }
    if task.test.iter().all(|view| view.world_from_camera.is_none()) {
        return Err(EvaluateError::NoTruth { path: path.to_path_buf(), frames: task.test.len() });
    }
    Ok(())
}
