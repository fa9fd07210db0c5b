//! A small untrained network and frames of a scene that slides by.
#![allow(dead_code, reason = "not every test program needs all of it")]

use std::sync::Arc;

use grnet_frame::{CaptureTime, Frame, PixelFormat, Pixels};
use grnet_geometry::Pose;
use grnet_model::{LoadedModel, NetworkConfig};
use grnet_pipeline::{Estimate, NoObserver, Pipeline, PipelineOptions};

pub const SIZE: (u32, u32) = (80, 60);
pub const PERIOD_NS: u64 = 40_000_000;

/// The layers of `grnet-small` on a smaller input, so that the tests stay quick.
pub fn config() -> NetworkConfig {
    NetworkConfig { input_height_px: 48, input_width_px: 64, width: 0.125, ..NetworkConfig::grnet_small() }
}

pub fn model() -> LoadedModel {
    LoadedModel::untrained(&config(), 11).unwrap()
}

pub fn pipeline() -> Pipeline {
    Pipeline::new(model(), PipelineOptions::default()).unwrap()
}

/// A frame of a scene that slides by; `sequence` also gives its time.
pub fn frame(sequence: u64) -> Frame {
    let byte = |x: u32, y: u32, c: u32| {
        let phase = f64::from(x) * 0.13 + f64::from(y * (c + 1)) * 0.05 + sequence as f64 * 0.3;
        (127.5 + 127.0 * phase.sin()) as u8
    };
    let rgb =
        (0..SIZE.1).flat_map(|y| (0..SIZE.0).flat_map(move |x| (0..3).map(move |c| byte(x, y, c)))).collect();
    Frame {
        pixels: Arc::new(Pixels::packed(PixelFormat::Rgb8, SIZE.0, SIZE.1, rgb).unwrap()),
        capture_time: CaptureTime::monotonic(1_000_000_000 + sequence * PERIOD_NS),
        sequence,
        camera: None,
    }
}

pub fn at_ns(sequence: u64, ns: u64) -> Frame {
    Frame { capture_time: CaptureTime::monotonic(ns), ..frame(sequence) }
}

pub fn step(pipeline: &mut Pipeline, sequence: u64) -> Estimate {
    pipeline.step(&frame(sequence), &mut NoObserver).unwrap()
}

pub fn assert_close(found: Option<Pose>, expected: &Pose) {
    let found = found.expect("a pose");
    let metres = (found.translation.vector - expected.translation.vector).norm();
    let radians = found.rotation.angle_to(&expected.rotation);
    assert!(metres < 1e-4 && radians < 1e-4, "{metres} m, {radians} rad");
}
