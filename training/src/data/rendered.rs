//! Windows rendered on the fly in synthetic rooms.
//!
//! Held-out recordings come from `grnet-train synth`, whose paths belong to sequences 0 to 98 of a seed. The paths here
//! belong to sequences from [`FIRST_SEQUENCE`] on. The sequence is the stream of the generator of a path and streams
//! share no numbers, so whatever the seeds, no path of a recording is ever trained on.

use std::sync::Arc;

use grnet_frame::{Camera, CaptureTime, Distortion, Frame, PixelFormat, Pixels};
use grnet_geometry::Pose;
use grnet_pipeline::preprocess::InputSpec;
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::augment::{AugmentOptions, Augmentation, Canvas, Developer, Scratch, Source};
use super::fingerprint::Fingerprint;
use super::image::{Pool, Resize, Rgb};
use super::window::{Purpose, Window, WindowOptions, Windows, check_share, generator};
use super::{DataError, FrameError};
use crate::synth::{
    FrameKey, GENERATOR_VERSION, PathOptions, RenderTarget, Scene, SceneOptions, Sensor, SensorOptions,
    SynthError, Trajectory, Volume, VolumeKind, pose_of,
};

/// The first sequence number of training paths; recordings have those below 99.
pub const FIRST_SEQUENCE: u32 = 1 << 31;

/// Width of the image for which [`SensorOptions`] and the focal length are stated.
const REFERENCE_WIDTH_PX: f64 = 640.0;

/// How windows are rendered.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RenderedOptions {
    /// Frames, strides, seed.
    pub window: WindowOptions,
    /// How they are changed; where this is given, fields that it leaves out are off.
    pub augment: AugmentOptions,
    /// Numbers of the rooms, drawn equally often; a room number is a place, as in `grnet-train synth --room`.
    pub rooms: Vec<u64>,
    /// Where the camera goes.
    pub volume: VolumeKind,
    /// Frames per second, which strides count.
    pub rate_hz: f64,
    /// Width and height of the rendered images, which are then resized as at run time. More is nearer to a resized
    /// camera image and slower.
    pub size_px: (u32, u32),
    /// Focal length at a width of 640 pixels.
    pub focal_px: f64,
    /// Size of a texel on walls and furniture in millimetres: a coarse one is built sooner.
    pub texel_mm: f64,
    /// Rays per pixel on silhouettes. The resize to the network's input smooths them too, so 1 does; 4 takes twice as
    /// long.
    pub edge_samples: usize,
    /// Least and largest strength of the sensor's noise, drawn for each window: 1 is a webcam of 640 pixels.
    pub noise: (f64, f64),
    /// Least and largest share of light that the corners lose, drawn for each window.
    pub vignetting: (f64, f64),
    /// Share of windows whose frames do not follow a path but jump from each to the next.
    pub jump_share: f64,
    /// Largest jump along each axis in metres.
    pub jump_m: f64,
    /// Largest jump of yaw in degrees; pitch and roll jump half as far.
    pub jump_deg: f64,
}

impl Default for RenderedOptions {
    fn default() -> Self {
        Self {
            window: WindowOptions::default(),
            augment: AugmentOptions::rendered(),
            rooms: vec![1],
            volume: VolumeKind::Handheld,
            rate_hz: 30.0,
            size_px: (160, 120),
            focal_px: 525.0,
            texel_mm: 10.0,
            edge_samples: 1,
            noise: (0.5, 1.5),
            vignetting: (0.1, 0.3),
            jump_share: 0.2,
            jump_m: 0.15,
            jump_deg: 12.0,
        }
    }
}

/// Windows of frames that nobody has seen before.
#[derive(Debug)]
pub struct RenderedWindows {
    options: RenderedOptions,
    input: InputSpec,
    camera: Camera,
    rooms: Vec<(Scene, Volume)>,
    developer: Developer,
    workshops: Pool<Workshop>,
}

/// What a thread renders with.
#[derive(Debug)]
struct Workshop {
    target: RenderTarget,
    resize: Resize,
    scratch: Scratch,
}

/// What is rendered for one window, before augmentation turns the camera.
#[derive(Debug)]
struct Shots {
    room: usize,
    /// In the window's order.
    frames: Vec<Shot>,
    seed: u64,
    sensor: SensorOptions,
    kind: &'static str,
}

/// One frame before it is rendered.
#[derive(Debug, Clone, Copy)]
struct Shot {
    world_from_camera: Pose,
    /// Exposure relative to the sensor's normal.
    gain: f32,
    /// Which noise it has.
    number: u32,
}

impl RenderedWindows {
    /// Builds the rooms, about a second each at 10 mm.
    ///
    /// # Errors
    /// When options make no sense.
    pub fn new(input: InputSpec, options: RenderedOptions) -> Result<Self, DataError> {
        options.check()?;
        let (width, height) = options.size_px;
        let focal_px = options.focal_px * f64::from(width) / REFERENCE_WIDTH_PX;
        let centre_px = (f64::from(width - 1) / 2.0, f64::from(height - 1) / 2.0);
        let camera = Camera::new(options.size_px, (focal_px, focal_px), centre_px, Distortion::None)
            .map_err(|_| DataError::option("focal_px", options.focal_px, "a positive number of pixels"))?;
        let build = |room: &u64| {
            let texel_m = (options.texel_mm / 1e3) as f32;
            let scene = Scene::build(SceneOptions { room: *room, texel_m });
            let volume = Volume::of(&scene, options.volume);
            (scene, volume)
        };
        let rooms = options.rooms.iter().map(build).collect();
        let developer = Developer::new(&input.preprocessing);
        Ok(Self { options, input, camera, rooms, developer, workshops: Pool::default() })
    }

    /// Intrinsics of the rendered images: what belongs into the checkpoint.
    pub fn camera(&self) -> Camera {
        self.camera
    }

    /// What was asked for.
    pub fn options(&self) -> &RenderedOptions {
        &self.options
    }

    fn shots(&self, index: u64) -> Result<Shots, DataError> {
        let WindowOptions { k, reverse_share, seed, .. } = self.options.window;
        let mut rng = generator(seed, Purpose::Choice, index);
        let room = rng.random_range(0..self.rooms.len());
        let offsets = self.options.window.draw_offsets(None, &mut rng);
        let between =
            |(low, high): (f64, f64), rng: &mut ChaCha8Rng| (low + (high - low) * rng.random::<f64>()) as f32;
        // Averaged over the pixels of a full-sized image that one pixel here stands for.
        let averaged = f64::from(self.options.size_px.0) / REFERENCE_WIDTH_PX;
        let sensor = SensorOptions {
            noise: between(self.options.noise, &mut rng) * averaged as f32,
            vignetting: between(self.options.vignetting, &mut rng),
            blur: 0.0,
            vary_exposure: true,
        };
        let (mut frames, noise_seed, kind) = if k == 1 || rng.random::<f64>() < self.options.jump_share {
            (self.jump(room, &mut rng), rng.random(), "jump")
        } else {
            let (frames, seed) =
                self.walk(room, &offsets, &mut rng).map_err(|source| self.cannot_render(index, source))?;
            (frames, seed, "path")
        };
        if rng.random::<f64>() < reverse_share {
            frames.reverse();
        }
        Ok(Shots { room, frames, seed: noise_seed, sensor, kind })
    }

    /// The frames at these places of a path of their own, and its seed.
    fn walk(
        &self,
        room: usize,
        offsets: &[u32],
        rng: &mut ChaCha8Rng,
    ) -> Result<(Vec<Shot>, u64), SynthError> {
        const ATTEMPTS: u32 = 8;
        let (scene, volume) = &self.rooms[room];
        let seed = rng.random();
        let path = |attempt: u32| {
            let (frames, rate_hz) = (offsets.last().map_or(1, |last| last + 1), self.options.rate_hz);
            let options = PathOptions { seed, sequence: FIRST_SEQUENCE + attempt, frames, rate_hz };
            Trajectory::generate(scene, volume, options)
        };
        // A short path may begin in a dead end; the next one begins elsewhere.
        let mut found = path(0);
        for attempt in 1..ATTEMPTS {
            if found.is_ok() {
                break;
            }
            found = path(attempt);
        }
        let path = found?;
        let frame = |(number, offset): (u32, &u32)| {
            let time_s = path.time_s(*offset);
            Shot { world_from_camera: path.world_from_camera(time_s), gain: path.gain(time_s), number }
        };
        Ok(((0..).zip(offsets).map(frame).collect(), seed))
    }

    /// K frames each of which lies at random within some reach of the one before.
    fn jump(&self, room: usize, rng: &mut ChaCha8Rng) -> Vec<Shot> {
        const TRIES: usize = 50;
        let (scene, volume) = &self.rooms[room];
        let (reach_m, reach_rad) = (self.options.jump_m, self.options.jump_deg.to_radians());
        let reach = [reach_m, reach_m, reach_m, reach_rad, reach_rad / 2.0, reach_rad / 2.0];
        let mut place = loop {
            let place = volume.draw(rng, 0.0);
            if volume.allows(scene, &place) {
                break place;
            }
        };
        let mut gain = rng.random_range(0.8..1.25f32);
        (0..self.options.window.k as u32)
            .map(|number| {
                if number > 0 {
                    let near = |rng: &mut ChaCha8Rng| -> [f64; 6] {
                        std::array::from_fn(|axis| place[axis] + reach[axis] * rng.random_range(-1.0..1.0))
                    };
                    let mut tries = (0..TRIES).map(|_| near(rng));
                    // Where there is no other place nearby the camera stays.
                    let next = tries.find(|near| is_within(volume, near) && volume.allows(scene, near));
                    place = next.unwrap_or(place);
                    gain = (gain * rng.random_range(0.98..1.02)).clamp(0.8, 1.25);
                }
                Shot { world_from_camera: pose_of(&place), gain, number }
            })
            .collect()
    }

    fn augmentation(&self, index: u64) -> Augmentation {
        let WindowOptions { k, seed, .. } = self.options.window;
        Augmentation::draw(&self.options.augment, k, &mut generator(seed, Purpose::Augment, index))
    }

    fn posed(shots: &Shots, augmentation: &Augmentation) -> Vec<Pose> {
        let turned = |(i, shot): (usize, &Shot)| match &augmentation.rotations {
            Some(rotations) => shot.world_from_camera * rotations[i],
            None => shot.world_from_camera,
        };
        shots.frames.iter().enumerate().map(turned).collect()
    }

    fn name(&self, index: u64, shots: &Shots) -> String {
        format!("room {} {} window {index}", self.options.rooms[shots.room], shots.kind)
    }

    fn cannot_render(&self, index: u64, source: SynthError) -> DataError {
        DataError::Synth { name: format!("rendered window {index}"), source }
    }

    /// The picture of one frame at the network's input size.
    fn picture(
        &self,
        shots: &Shots,
        i: usize,
        world_from_camera: &Pose,
        workshop: &mut Workshop,
    ) -> Result<Result<Rgb, FrameError>, SynthError> {
        let Shot { gain, number, .. } = shots.frames[i];
        self.rooms[shots.room].0.render(world_from_camera, &self.camera, &mut workshop.target)?;
        let key = FrameKey { seed: shots.seed, sequence: FIRST_SEQUENCE, index: number };
        let mut rgb = Vec::new();
        Sensor { options: shots.sensor }.develop(&workshop.target, key, gain, &mut rgb);
        let (width, height) = self.options.size_px;
        Ok(Pixels::packed(PixelFormat::Rgb8, width, height, rgb).map_err(FrameError::from).and_then(
            |pixels| {
                let frame = Frame {
                    pixels: Arc::new(pixels),
                    capture_time: CaptureTime::recorded(0),
                    sequence: 0,
                    camera: Some(self.camera),
                };
                Ok(workshop.resize.run(&frame)?)
            },
        ))
    }
}

impl Windows for RenderedWindows {
    fn k(&self) -> usize {
        self.options.window.k
    }

    fn window(&self, index: u64) -> Result<Window, DataError> {
        let shots = self.shots(index)?;
        let augmentation = self.augmentation(index);
        let world_from_camera = Self::posed(&shots, &augmentation);
        let name = self.name(index, &shots);
        let (width, height) = (self.input.size_px.0 as usize, self.input.size_px.1 as usize);
        let frame_length = 3 * width * height;
        let mut images = vec![0.0; world_from_camera.len() * frame_length];
        let unusable = |source| DataError::Rendered { name: name.clone(), source };
        let new_workshop = || {
            let resize =
                Resize::new(&self.input).map_err(|error| unusable(FrameError::Preprocess(error.into())))?;
            let target = RenderTarget::new(self.options.edge_samples);
            Ok(Workshop { target, resize, scratch: Scratch::default() })
        };
        self.workshops.with(new_workshop, |workshop| {
            for (i, planes) in images.chunks_exact_mut(frame_length).enumerate() {
                let picture = self.picture(&shots, i, &world_from_camera[i], workshop);
                let picture =
                    picture.map_err(|source| self.cannot_render(index, source))?.map_err(unusable)?;
                let canvas = Canvas { planes, width, height };
                let look = augmentation.look.as_ref();
                self.developer.run(Source::Exact(&picture), look, i, canvas, &mut workshop.scratch);
            }
            Ok(())
        })?;
        Ok(Window { images, world_from_camera, name })
    }

    fn poses(&self, index: u64) -> Result<Vec<Pose>, DataError> {
        Ok(Self::posed(&self.shots(index)?, &self.augmentation(index)))
    }

    fn size_px(&self) -> Option<(u32, u32)> {
        Some(self.input.size_px)
    }

    fn fingerprint(&self) -> String {
        let mut hash = Fingerprint::default();
        hash.text("rendered windows 1");
        hash.numbers(&[GENERATOR_VERSION.into()]);
        hash.options(&self.options);
        hash.input(&self.input);
        hash.finish()
    }

    fn describe(&self) -> String {
        let rooms = &self.options.rooms;
        let rooms =
            if rooms.len() == 1 { format!("room {}", rooms[0]) } else { format!("{} rooms", rooms.len()) };
        let (width, height) = self.options.size_px;
        format!(
            "{rooms} ({}) rendered at {width}x{height}, windows of {}",
            self.options.volume.name(),
            self.k()
        )
    }
}

impl RenderedOptions {
    fn check(&self) -> Result<(), DataError> {
        self.window.check()?;
        self.augment.check()?;
        if self.rooms.is_empty() {
            return Err(DataError::option("rooms", "none", "at least one room number"));
        }
        let size = self.size_px;
        if !(8..=4096).contains(&size.0) || !(8..=4096).contains(&size.1) {
            let found = format!("{}x{}", size.0, size.1);
            return Err(DataError::option("size_px", found, "8 to 4096 pixels a side"));
        }
        if !(1..=64).contains(&self.edge_samples) {
            return Err(DataError::option("edge_samples", self.edge_samples, "1 to 64"));
        }
        check_share("jump_share", self.jump_share)?;
        for (option, value, (least, most)) in [
            ("rate_hz", self.rate_hz, (1.0, 1000.0)),
            ("texel_mm", self.texel_mm, (1.0, 100.0)),
            ("jump_m", self.jump_m, (0.0, 2.0)),
            ("jump_deg", self.jump_deg, (0.0, 90.0)),
        ] {
            if !(least..=most).contains(&value) {
                return Err(DataError::option(option, value, format!("{least} to {most}")));
            }
        }
        for (option, (low, high), most) in [("noise", self.noise, 20.0), ("vignetting", self.vignetting, 1.0)]
        {
            if !(0.0 <= low && low <= high && high <= most) {
                let expected = format!("two numbers from 0 to {most}, the least first");
                return Err(DataError::option(option, format!("({low}, {high})"), expected));
            }
        }
        Ok(())
    }
}

/// Whether (x, y, z, yaw, pitch, roll) lies within the limits of the volume; [`Volume::allows`] looks at obstacles only.
fn is_within(volume: &Volume, place: &[f64; 6]) -> bool {
    let in_box = (0..3).all(|k| (place[k] - volume.centre_m[k]).abs() <= volume.half_m[k]);
    let yaw = volume.yaw_rad.is_none_or(|(middle, half)| (place[3] - middle).abs() <= half);
    let pitch = (volume.pitch_rad.0..=volume.pitch_rad.1).contains(&place[4]);
    in_box && yaw && pitch && place[5].abs() <= volume.roll_rad
}

#[cfg(test)]
mod tests {
    use grnet_model::Preprocessing;
    use image::codecs::jpeg::JpegEncoder;

    use super::*;

    const INPUT_PX: (u32, u32) = (112, 112);

    fn input() -> InputSpec {
        InputSpec { size_px: INPUT_PX, preprocessing: Preprocessing::default(), trained_camera: None }
    }

    /// What a camera of 640x480 that writes JPEGs shows of the place, resized as at run time.
    fn recorded(scene: &Scene, pose: &Pose) -> Rgb {
        let camera = Camera::new((640, 480), (525.0, 525.0), (319.5, 239.5), Distortion::None).unwrap();
        let mut target = RenderTarget::new(4);
        scene.render(pose, &camera, &mut target).unwrap();
        let (mut rgb, mut jpeg) = (Vec::new(), Vec::new());
        let options = SensorOptions { vary_exposure: false, ..SensorOptions::default() };
        Sensor { options }.develop(&target, FrameKey { seed: 1, sequence: 0, index: 0 }, 1.0, &mut rgb);
        JpegEncoder::new_with_quality(&mut jpeg, 92)
            .encode(&rgb, 640, 480, image::ExtendedColorType::Rgb8)
            .unwrap();
        let frame = Frame {
            pixels: Arc::new(grnet_capture::decode::decode_bytes(&jpeg).unwrap()),
            capture_time: CaptureTime::recorded(0),
            sequence: 0,
            camera: None,
        };
        Resize::new(&input()).unwrap().run(&frame).unwrap()
    }

    /// Means of the absolute difference, and of the absolute difference of neighbours in each picture: sharpness.
    fn compare(a: &Rgb, b: &Rgb) -> (f64, f64, f64) {
        let mean =
            |values: &mut dyn Iterator<Item = u8>, n: usize| values.map(f64::from).sum::<f64>() / n as f64;
        let n = a.data.len();
        let sharp =
            |rgb: &Rgb| mean(&mut rgb.data.iter().zip(&rgb.data[3..]).map(|(a, b)| a.abs_diff(*b)), n);
        (mean(&mut a.data.iter().zip(&b.data).map(|(a, b)| a.abs_diff(*b)), n), sharp(a), sharp(b))
    }

    /// Small pictures look like large ones that were made small: as alike as half the contrast of neighbouring pixels,
    /// and as sharp.
    #[test]
    fn the_look_is_that_of_a_camera_image_resized() {
        let options = RenderedOptions {
            window: WindowOptions { k: 1, ..WindowOptions::default() },
            noise: (1.0, 1.0),
            vignetting: (0.22, 0.22),
            ..RenderedOptions::default()
        };
        let windows = RenderedWindows::new(input(), options).unwrap();
        let fine = Scene::build(SceneOptions { room: 1, texel_m: 0.004 });
        let target = RenderTarget::new(windows.options.edge_samples);
        let (resize, scratch) = (Resize::new(&input()).unwrap(), Scratch::default());
        let mut workshop = Workshop { target, resize, scratch };
        let (mut apart, mut sharp, mut expected) = (0.0, 0.0, 0.0);
        const VIEWS: u64 = 8;
        for index in 0..VIEWS {
            let mut shots = windows.shots(index).unwrap();
            shots.sensor.vary_exposure = false;
            let pose = shots.frames[0].world_from_camera;
            let small = windows.picture(&shots, 0, &pose, &mut workshop).unwrap().unwrap();
            let (a, b, c) = compare(&small, &recorded(&fine, &pose));
            (apart, sharp, expected) = (apart + a, sharp + b, expected + c);
        }
        let told = format!(
            "{:.2} grey levels apart, neighbours {:.2} apart, {:.2} in the recording",
            apart / VIEWS as f64,
            sharp / VIEWS as f64,
            expected / VIEWS as f64
        );
        println!("{told}");
        assert!(apart < 0.5 * expected && (sharp / expected - 1.0).abs() < 0.15, "{told}");
    }
}
