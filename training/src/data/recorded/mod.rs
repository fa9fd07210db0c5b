//! Windows cut from the training frames of a recording.

mod frame;

use std::ops::Range;
use std::path::Path;
use std::sync::Arc;

use frame::{Stored, TrainingFrame, fingerprint, runs, with_focal};
use grnet_capture::dataset::Recording;
use grnet_capture::decode::decode_file;
use grnet_frame::{Camera, CaptureTime, Frame, Pixels};
use grnet_geometry::Pose;
use grnet_pipeline::preprocess::InputSpec;
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use rand::Rng;
use serde::{Deserialize, Serialize};

use super::augment::{AugmentOptions, Augmentation, Canvas, Developer, Scratch, Source, Warp};
use super::image::{Lens, Pool, Resize, Rgb, kept};
use super::views::{Artist, Station, ViewOptions, Views};
use super::window::{Purpose, Window, WindowOptions, Windows, generator};
use super::{DataError, FrameError};
use crate::evaluate::Data;

/// How windows are cut from a recording.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RecordedOptions {
    /// Frames, strides, seed.
    pub window: WindowOptions,
    /// How they are changed; where this is given, fields that it leaves out are off.
    pub augment: AugmentOptions,
    /// How they are seen from where the camera never was [default: not at all]. Needs intrinsics, as rotations do, and frames
    /// whose poses fit their images.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub views: Option<ViewOptions>,
    /// Focal length in pixels of the stored images, instead of what the recording says.
    pub focal_px: Option<f64>,
    /// Pixels of the images kept for rotated views, along each side and for each pixel of the network's input. More
    /// is sharper and takes more memory.
    pub work_scale: f64,
    /// Most memory for decoded and resized frames in MiB; frames beyond it are decoded again whenever they are drawn,
    /// some milliseconds each. Changes no window.
    pub cache_mib: usize,
}

impl Default for RecordedOptions {
    fn default() -> Self {
        Self {
            window: WindowOptions::default(),
            augment: AugmentOptions::recorded(),
            views: None,
            focal_px: None,
            work_scale: 1.15,
            cache_mib: 512,
        }
    }
}

/// Windows from a recording's training frames.
///
/// A window lies inside one run of neighbouring frames that all have a pose, so it never shows a frame outside the
/// training list and never jumps over one. Frames are decoded when they are first drawn.
#[derive(Debug)]
pub struct RecordedWindows {
    options: RecordedOptions,
    input: InputSpec,
    frames: Vec<TrainingFrame>,
    /// Runs of at least K neighbours, as ranges of `frames`, and the number of frames in all runs up to each.
    blocks: Vec<(Range<usize>, usize)>,
    views: Option<Views>,
    developer: Developer,
    readers: Pool<Reader>,
    fingerprint: String,
    name: String,
}

/// What a thread decodes and draws with.
#[derive(Debug)]
struct Reader {
    exact: Resize,
    whole: Option<Resize>,
    scratch: Scratch,
    artist: Artist,
}

/// How the camera of a frame is changed: first moved, in its own axes, and then turned.
#[derive(Debug, Clone, Copy)]
struct Change {
    shift: Option<Vector3<f64>>,
    rotation: Option<UnitQuaternion<f64>>,
}

impl Change {
    fn is_any(&self) -> bool {
        self.shift.is_some() || self.rotation.is_some()
    }

    fn camera_from_changed(&self) -> Pose {
        let shift = Translation3::from(self.shift.unwrap_or_default());
        Pose::from_parts(shift, self.rotation.unwrap_or_default())
    }
}

impl RecordedWindows {
    /// Windows from all frames of `recordings` that have a pose; `path` is the recording's folder. Open the recording
    /// with a training split or list to leave the others out.
    ///
    /// # Errors
    /// When options make no sense, no run of frames is long enough for a window, an image file is missing, or rotations
    /// are asked for without intrinsics.
    pub fn new(
        path: &Path,
        recordings: &[Recording],
        input: InputSpec,
        options: RecordedOptions,
    ) -> Result<Self, DataError> {
        let mut frames = Vec::new();
        for (sequence, recording) in recordings.iter().enumerate() {
            for frame in &recording.frames {
                let Some(pose) = frame.world_from_camera else { continue };
                let camera = frame.camera.or(recording.camera);
                let camera = with_focal(camera, recording.image_size_px, options.focal_px)?;
                frames.push(TrainingFrame::new(&frame.path, (sequence, frame.sequence), pose, camera));
            }
        }
        let size_px = recordings.iter().find_map(|recording| recording.image_size_px);
        Self::from_frames(path, frames, size_px, input, options)
    }

    /// Windows from the training frames of an opened [`Data`].
    ///
    /// # Errors
    /// As [`RecordedWindows::new`].
    pub fn from_data(data: &Data, input: InputSpec, options: RecordedOptions) -> Result<Self, DataError> {
        let mut frames = Vec::new();
        for (view, pose) in data.task.train_poses() {
            let recording = &data.recordings[view.sequence];
            let own = recording.frames.get(view.index as usize).and_then(|frame| frame.camera);
            let camera = with_focal(own.or(recording.camera), recording.image_size_px, options.focal_px)?;
            frames.push(TrainingFrame::new(&view.image, (view.sequence, view.index), pose, camera));
        }
        let size_px = data.recordings.iter().find_map(|recording| recording.image_size_px);
        Self::from_frames(&data.path, frames, size_px, input, options)
    }

    fn from_frames(
        path: &Path,
        mut frames: Vec<TrainingFrame>,
        size_px: Option<(u32, u32)>,
        input: InputSpec,
        options: RecordedOptions,
    ) -> Result<Self, DataError> {
        options.check(&input)?;
        let k = options.window.k;
        let runs = runs(&frames);
        let longest = runs.iter().map(Range::len).max().unwrap_or(0);
        let mut total = 0;
        let blocks: Vec<_> = runs
            .into_iter()
            .filter(|run| run.len() >= k)
            .map(|run| {
                total += run.len();
                (run, total)
            })
            .collect();
        if blocks.is_empty() {
            let frames = frames.len();
            return Err(DataError::NoWindows { path: path.into(), k, frames, longest });
        }
        if (options.augment.rotates() || options.views.is_some())
            && let Some(frame) = frames.iter().find(|frame| frame.camera.is_none())
        {
            return Err(DataError::NoIntrinsics { path: frame.path.clone() });
        }
        let fitting = options.frames_cached(size_px, &input);
        for frame in frames.iter_mut().take(fitting) {
            frame.is_cached = true;
        }
        let views = options.views.map(|views| {
            let station = |frame: &TrainingFrame| {
                let camera = frame.camera?;
                let stored_px = options.work_px(camera.size_px(), &input);
                let lens = Lens::of_stored(&camera, stored_px);
                Some(Station { world_from_camera: frame.world_from_camera, lens, size_px: stored_px })
            };
            Views::new(views, frames.iter().filter_map(station).collect())
        });
        let fingerprint = fingerprint(path, &frames, &input, &options)?;
        let developer = Developer::new(&input.preprocessing);
        let name = path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
        let readers = Pool::default();
        Ok(Self { options, input, frames, blocks, views, developer, readers, fingerprint, name })
    }

    /// Uses the depths that `other` finds, or has found, where both see the same frames.
    pub fn share_depths(&mut self, other: &Self) {
        fn paths(frames: &[TrainingFrame]) -> impl Iterator<Item = &Path> {
            frames.iter().map(|frame| &*frame.path)
        }
        let same_images = paths(&self.frames).eq(paths(&other.frames));
        if let (Some(own), Some(other), true) = (&mut self.views, &other.views, same_images) {
            own.share(other);
        }
    }

    /// Intrinsics of the images as the network sees them before they are resized, undistorted: what belongs into the
    /// checkpoint. `None` when the recording does not tell.
    pub fn camera(&self) -> Option<Camera> {
        self.frames[0].camera.map(|camera| camera.undistorted())
    }

    /// What was asked for.
    pub fn options(&self) -> &RecordedOptions {
        &self.options
    }

    /// The frames of window `index`, in its order.
    fn choose(&self, index: u64) -> Vec<usize> {
        let WindowOptions { k, reverse_share, seed, .. } = self.options.window;
        let mut rng = generator(seed, Purpose::Choice, index);
        let total = self.blocks.last().map_or(0, |(_, total)| *total);
        // Every frame belongs to the block that is drawn equally often.
        let ticket = rng.random_range(0..total);
        let (block, _) = &self.blocks[self.blocks.partition_point(|(_, up_to)| *up_to <= ticket)];
        let longest =
            (block.len() - 1).checked_div(k - 1).map(|frames| u32::try_from(frames).unwrap_or(u32::MAX));
        let offsets = self.options.window.draw_offsets(longest, &mut rng);
        let length = offsets.last().map_or(0, |last| *last as usize);
        let start = block.start + rng.random_range(0..block.len() - length);
        let mut chosen: Vec<usize> = offsets.iter().map(|offset| start + *offset as usize).collect();
        if rng.random::<f64>() < reverse_share {
            chosen.reverse();
        }
        chosen
    }

    fn augmentation(&self, index: u64) -> Augmentation {
        let WindowOptions { k, seed, .. } = self.options.window;
        Augmentation::draw(&self.options.augment, k, &mut generator(seed, Purpose::Augment, index))
    }

    /// What is done to the cameras of window `index`.
    fn changes(&self, index: u64, chosen: &[usize], augmentation: &Augmentation) -> Vec<Change> {
        let is_plain = *augmentation == Augmentation::none();
        let views = self.views.as_ref().filter(|_| !is_plain);
        let shifts = views.and_then(|views| views.shifts(chosen, self.options.window.seed, index));
        let change = |i| Change {
            shift: shifts.as_ref().map(|shifts| shifts[i]),
            rotation: augmentation.rotations.as_ref().map(|rotations| rotations[i]),
        };
        (0..chosen.len()).map(change).collect()
    }

    fn posed(&self, chosen: &[usize], changes: &[Change]) -> Vec<Pose> {
        let pose = |(frame, change): (&usize, &Change)| {
            self.frames[*frame].world_from_camera * change.camera_from_changed()
        };
        chosen.iter().zip(changes).map(pose).collect()
    }

    fn name_of(&self, chosen: &[usize]) -> String {
        let numbers: Vec<String> =
            chosen.iter().map(|frame| self.frames[*frame].place.1.to_string()).collect();
        let path = &self.frames[chosen[0]].path;
        let sequence = path.parent().and_then(Path::file_name).unwrap_or_default().to_string_lossy();
        format!("{}/{sequence} frames {}", self.name, numbers.join(" "))
    }

    fn stored(&self, frame: &TrainingFrame, reader: &mut Reader) -> Result<Stored, DataError> {
        if let Some(stored) = frame.cache.get() {
            return Ok(stored.clone());
        }
        let read = self.read(frame, reader);
        let stored = read.map_err(|source| DataError::Frame { path: frame.path.clone(), source })?;
        if frame.is_cached {
            // Another thread may have been faster; both have the same.
            let _ = frame.cache.set(stored.clone());
        }
        Ok(stored)
    }

    /// The whole image, where views are drawn.
    fn whole(&self, frame: &TrainingFrame, reader: &mut Reader) -> Result<Arc<Rgb>, DataError> {
        let Some(whole) = self.stored(frame, reader)?.whole else { unreachable!("`needs` says otherwise") };
        Ok(whole)
    }

    fn read(&self, frame: &TrainingFrame, reader: &mut Reader) -> Result<Stored, FrameError> {
        let pixels = Arc::new(decode_file(&frame.path)?);
        let (needs_exact, needs_whole) = self.options.needs();
        let size_px = self.options.work_px(size_of(&pixels), &self.input);
        let frame =
            Frame { pixels, capture_time: CaptureTime::recorded(0), sequence: 0, camera: frame.camera };
        let exact = needs_exact.then(|| reader.exact.run(&frame)).transpose()?.map(Arc::new);
        let mut whole = None;
        if needs_whole {
            let fitting = reader.whole.take().filter(|resize| resize.size_px() == size_px);
            let mut resize =
                fitting.map_or_else(|| Resize::whole(&self.input, size_px), Ok).map_err(intrinsics)?;
            whole = Some(Arc::new(resize.run(&frame)?));
            reader.whole = Some(resize);
        }
        Ok(Stored { exact, whole })
    }

    fn draw(
        &self,
        (i, number): (usize, usize),
        (change, augmentation): (&Change, &Augmentation),
        planes: &mut [f32],
        reader: &mut Reader,
    ) -> Result<(), DataError> {
        let frame = &self.frames[number];
        let stored = self.stored(frame, reader)?;
        let size_px = self.input.size_px;
        let size = (size_px.0 as usize, size_px.1 as usize);
        let canvas = Canvas { planes, width: size.0, height: size.1 };
        let look = augmentation.look.as_ref();
        let (policy, border) = (self.input.preprocessing.resize, self.options.augment.border);
        let views = self.views.as_ref().filter(|views| change.is_any() && views.has_depth(number));
        let mut artist = std::mem::take(&mut reader.artist);
        let warp;
        let source = match (views, &change.rotation, &frame.camera, &stored.whole, &stored.exact) {
            (Some(views), _, Some(camera), ..) => {
                let image = |other: usize| self.whole(&self.frames[other], reader);
                let input = Lens::of_input(camera, policy, size_px);
                let (pose, look) = (change.camera_from_changed(), (border, self.developer.mean()));
                Source::Exact(views.draw(&mut artist, (number, &pose), (input, size), look, image)?)
            }
            (_, Some(rotation), Some(camera), Some(whole), _) => {
                let stored_px = (whole.width as u32, whole.height as u32);
                warp = Warp::new(camera, rotation, policy, size_px, stored_px, border);
                Source::Warped(whole, &warp)
            }
            (.., Some(exact)) => Source::Exact(exact),
            _ => unreachable!("`needs` and the check of intrinsics say otherwise"),
        };
        self.developer.run(source, look, i, canvas, &mut reader.scratch);
        reader.artist = artist;
        Ok(())
    }
}

impl Windows for RecordedWindows {
    fn k(&self) -> usize {
        self.options.window.k
    }

    fn window(&self, index: u64) -> Result<Window, DataError> {
        let chosen = self.choose(index);
        let augmentation = self.augmentation(index);
        let changes = self.changes(index, &chosen, &augmentation);
        let (width, height) = self.input.size_px;
        let frame_length = 3 * width as usize * height as usize;
        let mut images = vec![0.0; chosen.len() * frame_length];
        let first = &self.frames[chosen[0]];
        let new_reader = || {
            let exact = Resize::new(&self.input)
                .map_err(|error| DataError::Frame { path: first.path.clone(), source: intrinsics(error) })?;
            Ok(Reader { exact, whole: None, scratch: Scratch::default(), artist: Artist::default() })
        };
        self.readers.with(new_reader, |reader| {
            for (i, planes) in images.chunks_exact_mut(frame_length).enumerate() {
                self.draw((i, chosen[i]), (&changes[i], &augmentation), planes, reader)?;
            }
            Ok(())
        })?;
        let world_from_camera = self.posed(&chosen, &changes);
        Ok(Window { images, world_from_camera, name: self.name_of(&chosen) })
    }

    fn poses(&self, index: u64) -> Result<Vec<Pose>, DataError> {
        let chosen = self.choose(index);
        Ok(self.posed(&chosen, &self.changes(index, &chosen, &self.augmentation(index))))
    }

    fn size_px(&self) -> Option<(u32, u32)> {
        Some(self.input.size_px)
    }

    fn fingerprint(&self) -> String {
        self.fingerprint.clone()
    }

    fn describe(&self) -> String {
        format!(
            "recording {}: {} training frames in {} runs, windows of {}",
            self.name,
            self.frames.len(),
            self.blocks.len(),
            self.options.window.k
        )
    }
}

impl RecordedOptions {
    fn check(&self, input: &InputSpec) -> Result<(), DataError> {
        self.window.check()?;
        self.augment.check()?;
        if let Some(views) = &self.views {
            views.check(input.size_px)?;
        }
        if !(0.5..=4.0).contains(&self.work_scale) {
            return Err(DataError::option("work_scale", self.work_scale, "0.5 to 4"));
        }
        Ok(())
    }

    /// Whether images as at run time and whole images are needed.
    fn needs(&self) -> (bool, bool) {
        let rotates = self.augment.rotates();
        (!rotates || self.augment.plain_share > 0.0, rotates || self.views.is_some())
    }

    /// Size at which the whole of an image of `size_px` is kept.
    fn work_px(&self, size_px: (u32, u32), input: &InputSpec) -> (u32, u32) {
        let [_, _, width, height] = kept(input.preprocessing.resize, size_px, input.size_px);
        let side = |whole: u32, part: f64, input: u32| {
            ((f64::from(whole) / part * f64::from(input) * self.work_scale).round() as u32).max(1)
        };
        (side(size_px.0, width, input.size_px.0), side(size_px.1, height, input.size_px.1))
    }

    /// How many frames `cache_mib` holds.
    fn frames_cached(&self, size_px: Option<(u32, u32)>, input: &InputSpec) -> usize {
        let bytes = |(width, height): (u32, u32)| width as usize * height as usize * 3;
        let (exact, whole) = self.needs();
        let mut each = 0;
        if exact {
            each += bytes(input.size_px);
        }
        if whole {
            each += bytes(self.work_px(size_px.unwrap_or(input.size_px), input));
        }
        self.cache_mib * (1 << 20) / each.max(1)
    }
}

fn size_of(pixels: &Pixels) -> (u32, u32) {
    (pixels.width_px(), pixels.height_px())
}

fn intrinsics(error: grnet_pipeline::IntrinsicsError) -> FrameError {
    FrameError::Preprocess(error.into())
}
