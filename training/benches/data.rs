//! Time of one window of training data on one core: cut from a recording, and rendered. Divide by K for a frame.

use std::hint::black_box;

use criterion::{BatchSize, BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use grnet_capture::dataset::{self, OpenOptions};
use grnet_model::Preprocessing;
use grnet_pipeline::preprocess::InputSpec;
use grnet_train::data::{
    AugmentOptions, RecordedOptions, RecordedWindows, RenderedOptions, RenderedWindows, ViewOptions,
    WindowOptions, Windows,
};
use image::RgbImage;

const FRAMES: u32 = 64;
const K: usize = 5;

fn input(side: u32) -> InputSpec {
    InputSpec { size_px: (side, side), preprocessing: Preprocessing::default(), trained_camera: None }
}

/// A recording of images with some texture, in the layout of 7-Scenes.
fn recording() -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let sequence = folder.path().join("seq-01");
    std::fs::create_dir(&sequence).expect("a folder");
    for frame in 0..FRAMES {
        let image = RgbImage::from_fn(640, 480, |x, y| {
            image::Rgb([x / 3 + (x * y) % 17 + frame, y / 2 + (x ^ y) % 23, (x + y) / 5].map(|v| v as u8))
        });
        image.save(sequence.join(format!("frame-{frame:06}.color.jpg"))).expect("an image is written");
        let pose = format!("1 0 0 {}\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", f64::from(frame) / 100.0);
        std::fs::write(sequence.join(format!("frame-{frame:06}.pose.txt")), pose).expect("a pose is written");
    }
    folder
}

fn recorded(criterion: &mut Criterion) {
    let folder = recording();
    let recordings = dataset::open(folder.path(), &OpenOptions::default()).expect("a recording");
    let mut group = criterion.benchmark_group("recorded");
    group.throughput(Throughput::Elements(K as u64));
    for side in [112, 224] {
        let warp = AugmentOptions { rotation_deg: 12.0, ..AugmentOptions::default() };
        let colour =
            AugmentOptions { plain_share: 0.0, blur_share: 0.0, noise: 0.0, ..AugmentOptions::rendered() };
        let blur = AugmentOptions { plain_share: 0.0, blur_share: 1.0, ..AugmentOptions::recorded() };
        let all = AugmentOptions { plain_share: 0.0, ..AugmentOptions::recorded() };
        let moved = Some(ViewOptions { share: 1.0, ..ViewOptions::default() });
        for (name, augment, views) in [
            ("plain", AugmentOptions::default(), None),
            ("warp", warp, None),
            ("warp from elsewhere", warp, moved),
            ("colour", colour, None),
            ("everything", all, None),
            ("everything and blur", blur, None),
        ] {
            let options = RecordedOptions { augment, views, ..RecordedOptions::default() };
            let windows =
                RecordedWindows::new(folder.path(), &recordings, input(side), options).expect("windows");
            // Every frame is decoded once.
            (0..200).for_each(|index| drop(windows.window(index)));
            let mut index = 0;
            group.bench_function(BenchmarkId::new(name, side), |bencher| {
                bencher.iter(|| {
                    index += 1;
                    black_box(windows.window(index).expect("a window"))
                });
            });
        }
    }
    group.finish();
}

/// The first view of a frame: seven images decoded, and its depth found.
fn depth(criterion: &mut Criterion) {
    let folder = recording();
    let recordings = dataset::open(folder.path(), &OpenOptions::default()).expect("a recording");
    let mut group = criterion.benchmark_group("first view of a frame");
    group.sample_size(20);
    for side in [112, 224] {
        let make = || {
            let options = RecordedOptions {
                window: WindowOptions { k: 1, ..WindowOptions::default() },
                augment: AugmentOptions { rotation_deg: 12.0, ..AugmentOptions::default() },
                views: Some(ViewOptions { share: 1.0, ..ViewOptions::default() }),
                ..RecordedOptions::default()
            };
            RecordedWindows::new(folder.path(), &recordings, input(side), options).expect("windows")
        };
        group.bench_function(BenchmarkId::from_parameter(side), |bencher| {
            bencher.iter_batched_ref(
                make,
                |windows| black_box(windows.window(0).expect("a window")),
                BatchSize::PerIteration,
            );
        });
    }
    group.finish();
}

fn rendered(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("rendered");
    group.throughput(Throughput::Elements(K as u64)).sample_size(20);
    for (size_px, edge_samples, jump_share) in [
        ((160, 120), 4, 0.0),
        ((160, 120), 4, 1.0),
        ((160, 120), 2, 0.0),
        ((160, 120), 1, 0.0),
        ((112, 84), 4, 0.0),
        ((224, 168), 1, 0.0),
    ] {
        let options = RenderedOptions {
            window: WindowOptions { k: K, ..WindowOptions::default() },
            size_px,
            edge_samples,
            jump_share,
            ..RenderedOptions::default()
        };
        let windows = RenderedWindows::new(input(112), options).expect("windows");
        let mut index = 0;
        let name = format!("{}x{}, {edge_samples} rays, jumps {jump_share}", size_px.0, size_px.1);
        group.bench_function(name, |bencher| {
            bencher.iter(|| {
                index += 1;
                black_box(windows.window(index).expect("a window"))
            });
        });
        let name = format!("poses only, jumps {jump_share}, {size_px:?}");
        group.bench_function(name, |bencher| {
            bencher.iter(|| {
                index += 1;
                black_box(windows.poses(index).expect("poses"))
            });
        });
    }
    group.finish();
}

criterion_group!(benches, recorded, depth, rendered);
criterion_main!(benches);
