//! Time to score a trajectory as long as KITTI 00 (4541 poses), from text to figures.

use std::{hint::black_box, path::Path};

use criterion::{Criterion, criterion_group, criterion_main};
use grnet_geometry::{
    Pose,
    align::Alignment,
    nalgebra::Vector3,
    scores::{ate, kitti, rpe},
    trajectory::{self, KittiPoses},
};

const POSES: usize = 4541;

/// Drives about 0.8 m a frame with slow turns; `factor` makes the estimate differ.
fn drive(factor: f64) -> Vec<Pose> {
    let mut poses = vec![Pose::identity()];
    for i in 1..POSES {
        let turn = 0.01 * (i as f64 / 60.0).sin() * factor;
        let step = Pose::new(Vector3::new(0.0, 0.0, 0.82 * factor), Vector3::new(0.0, turn, 0.0));
        poses.push(poses[i - 1] * step);
    }
    poses
}

fn scores(criterion: &mut Criterion) {
    let (truth, estimate) = (drive(1.0), drive(1.01));
    let (kitti_truth, kitti_estimate) = (KittiPoses::from_poses(&truth), KittiPoses::from_poses(&estimate));
    let text = trajectory::kitti::format(&kitti_estimate);
    let mut group = criterion.benchmark_group("4541_poses");
    group.bench_function("parse_kitti", |b| {
        b.iter(|| trajectory::kitti::parse(black_box(&text), Path::new("00.txt")).unwrap());
    });
    group.bench_function("kitti_segments", |b| {
        b.iter(|| kitti::score(&kitti_truth, black_box(&kitti_estimate), kitti::Arithmetic::Double).unwrap());
    });
    for alignment in [Alignment::None, Alignment::Sim3] {
        group.bench_function(format!("ate_{alignment:?}"), |b| {
            b.iter(|| ate::score(&truth, black_box(&estimate), alignment).unwrap());
        });
    }
    group.bench_function("rpe_1_frame", |b| {
        b.iter(|| rpe::score(&truth, black_box(&estimate), &rpe::RpeOptions::default()).unwrap());
    });
    let metres = rpe::RpeOptions { delta: rpe::Delta::Metres(100.0), all_pairs: true, ..Default::default() };
    group.bench_function("rpe_100_m_all_pairs", |b| {
        b.iter(|| rpe::score(&truth, black_box(&estimate), &metres).unwrap());
    });
    group.finish();
}

criterion_group!(benches, scores);
criterion_main!(benches);
