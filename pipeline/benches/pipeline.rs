//! Time per frame: preprocessing of 640x480 frames to 224x224, and a whole step.

use std::hint::black_box;
use std::sync::Arc;

use criterion::{Criterion, criterion_group, criterion_main};
use grnet_frame::{Camera, CaptureTime, Distortion, Frame, PixelFormat, Pixels};
use grnet_model::{LoadedModel, NetworkConfig, Preprocessing};
use grnet_pipeline::preprocess::{InputSpec, Preprocessor};
use grnet_pipeline::{IntrinsicsOptions, NoObserver, Pipeline, PipelineOptions};
use image::ExtendedColorType;
use image::codecs::jpeg::JpegEncoder;

const SIZE: (u32, u32) = (640, 480);

/// A smooth picture with some texture, so that the JPEG is neither trivial nor noise.
fn rgb() -> Vec<u8> {
    (0..SIZE.1)
        .flat_map(|y| (0..SIZE.0).map(move |x| (x, y)))
        .flat_map(|(x, y)| [x / 3 + (x * y) % 17, y / 2 + (x ^ y) % 23, (x + y) / 5].map(|v| v as u8))
        .collect()
}

fn frame(format: PixelFormat, data: Vec<u8>, sequence: u64) -> Frame {
    Frame {
        pixels: Arc::new(Pixels::packed(format, SIZE.0, SIZE.1, data).expect("a whole image")),
        capture_time: CaptureTime::recorded(1 + sequence * 33_000_000),
        sequence,
        camera: None,
    }
}

fn jpeg() -> Vec<u8> {
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, 85)
        .encode(&rgb(), SIZE.0, SIZE.1, ExtendedColorType::Rgb8)
        .expect("encodes");
    bytes
}

fn preprocess(c: &mut Criterion) {
    let spec =
        || InputSpec { size_px: (224, 224), preprocessing: Preprocessing::default(), trained_camera: None };
    let yuyv = rgb().chunks(3).flat_map(|rgb| [rgb[1], rgb[2] / 2 + 64]).collect();
    let fisheye = Camera::new(SIZE, (300.0, 300.0), (319.5, 239.5), Distortion::Equidistant([0.01; 4]));
    let cases = [
        ("rgb", frame(PixelFormat::Rgb8, rgb(), 0), None),
        ("yuyv", frame(PixelFormat::Yuyv, yuyv, 0), None),
        ("nv12", frame(PixelFormat::Nv12, rgb()[..(SIZE.0 * SIZE.1 * 3 / 2) as usize].to_vec(), 0), None),
        ("jpeg", frame(PixelFormat::Jpeg, jpeg(), 0), None),
        ("rgb_undistorted", frame(PixelFormat::Rgb8, rgb(), 0), fisheye.clone().ok()),
        ("jpeg_undistorted", frame(PixelFormat::Jpeg, jpeg(), 0), fisheye.ok()),
    ];
    let mut group = c.benchmark_group("preprocess_640x480_to_224x224");
    for (name, frame, camera) in cases {
        let mut preprocessor =
            Preprocessor::new(spec(), IntrinsicsOptions::default(), camera).expect("no camera to refuse");
        group.bench_function(name, |b| {
            b.iter(|| black_box(preprocessor.run(black_box(&frame)).expect("a good frame").len()));
        });
    }
}

fn step(c: &mut Criterion) {
    let model = LoadedModel::untrained(&NetworkConfig::grnet_small(), 1).expect("the preset is valid");
    let mut pipeline = Pipeline::new(model, PipelineOptions::default()).expect("the defaults are valid");
    let mut next = frame(PixelFormat::Rgb8, rgb(), 0);
    let mut group = c.benchmark_group("step");
    group.sample_size(20);
    group.bench_function("grnet_small_rgb_640x480", |b| {
        b.iter(|| {
            next.sequence += 1;
            next.capture_time.ns += 33_000_000;
            black_box(pipeline.step(&next, &mut NoObserver).expect("a good frame"))
        });
    });
}

criterion_group!(benches, preprocess, step);
criterion_main!(benches);
