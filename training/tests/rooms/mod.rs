//! A recorded room, and what can be seen in it.

use std::sync::Arc;

use grnet_frame::{Camera, CaptureTime, Distortion, Frame};
use grnet_model::{Preprocessing, ResizePolicy};
use grnet_pipeline::IntrinsicsOptions;
use grnet_pipeline::preprocess::{InputSpec, Preprocessor};
use grnet_train::synth::{
    FrameKey, ImageFormat, Recipe, RenderTarget, Scene, SceneOptions, Sensor, SensorOptions, Shutter,
    VolumeKind, write,
};
use nalgebra::Isometry3;

const SIZE: (u32, u32) = (320, 240);

fn room_camera() -> Camera {
    Camera::new(SIZE, (262.5, 262.5), (159.5, 119.5), Distortion::None).unwrap()
}

/// A recording of a room by a perfect sensor, and the room.
pub fn room(frames: u32, rate_hz: f64) -> (tempfile::TempDir, Scene) {
    let folder = tempfile::tempdir().unwrap();
    let scene = SceneOptions { room: 1, texel_m: 0.02 };
    let recipe = Recipe {
        scene,
        volume: VolumeKind::Handheld,
        seed: 5,
        sequences: 1,
        test_sequences: 0,
        frames,
        rate_hz,
        camera: room_camera(),
        format: ImageFormat::Png,
        depth: false,
        edge_samples: 8,
        sensor: SensorOptions::clean(),
        shutter: Shutter::default(),
    };
    let out = folder.path().join("room");
    write(&recipe, &out, &|| {}).unwrap();
    for entry in std::fs::read_dir(&out).unwrap() {
        let from = entry.unwrap().path();
        std::fs::rename(&from, folder.path().join(from.file_name().unwrap())).unwrap();
    }
    (folder, Scene::build(scene))
}

/// What the network would see of the room from a pose.
pub fn seen(scene: &Scene, world_from_camera: &Isometry3<f64>, input: &InputSpec) -> Vec<f32> {
    let mut target = RenderTarget::new(8);
    scene.render(world_from_camera, &room_camera(), &mut target).unwrap();
    let mut rgb = Vec::new();
    let key = FrameKey { seed: 0, sequence: 0, index: 0 };
    Sensor { options: SensorOptions::clean() }.develop(&target, key, 1.0, &mut rgb);
    let pixels = grnet_frame::Pixels::packed(grnet_frame::PixelFormat::Rgb8, SIZE.0, SIZE.1, rgb).unwrap();
    let frame = Frame {
        pixels: Arc::new(pixels),
        capture_time: CaptureTime::recorded(0),
        sequence: 0,
        camera: Some(room_camera()),
    };
    let mut preprocessor = Preprocessor::new(input.clone(), IntrinsicsOptions::default(), None).unwrap();
    preprocessor.run(&frame).unwrap().to_vec()
}

pub fn input(width: u32, height: u32, resize: ResizePolicy) -> InputSpec {
    let preprocessing = Preprocessing { resize, ..Preprocessing::default() };
    InputSpec { size_px: (width, height), preprocessing, trained_camera: None }
}
