//! Drawn weights: the full-size network with its counts, and the same numbers from the same seed.

mod common;

use common::{frame_for, tiny, values};
use grnet_model::candle_core::Device;
use grnet_model::{Branches, LoadedModel, NetworkConfig, PRESETS, Preprocessing, Provenance, untrained};

#[test]
fn full_size_tensors_add_up_to_the_papers_number() {
    let config = NetworkConfig::grnet();
    let checkpoint = untrained::checkpoint(&config, 0, Preprocessing::default()).unwrap();
    let tensors = checkpoint.into_tensors(&Device::Cpu).unwrap();
    let learnt = tensors.iter().filter(|(name, _)| !name.contains(".running_"));
    let created: usize = learnt.map(|(_, tensor)| tensor.elem_count()).sum();
    assert_eq!(created, config.parameter_count());
    assert_eq!((created as f64 / 1e5).round(), 857.0);
}

#[test]
fn a_seed_fixes_every_weight() {
    let hash = |seed| {
        let checkpoint = untrained::checkpoint(&tiny(), seed, Preprocessing::default()).unwrap();
        checkpoint.content_hash().to_owned()
    };
    assert_eq!(hash(7), hash(7));
    assert_ne!(hash(7), hash(8));
    // Pinned: another value means another generator, which must get another name.
    assert_eq!(untrained::GENERATOR, "grnet chacha8 v1");
    assert_eq!(hash(7), "1e9f5d66c402157791c181d70f4287f4d2c693afa5087ba5313f1c0ec8db20fc");
}

#[test]
fn networks_that_share_a_part_and_a_seed_share_its_weights() {
    let config = tiny();
    let part = NetworkConfig {
        branches: Branches { relative: true, global: false, fusion: false },
        ..config.clone()
    };
    let draw = |config: &NetworkConfig| {
        let checkpoint = untrained::checkpoint(config, 3, Preprocessing::default()).unwrap();
        checkpoint.into_tensors(&Device::Cpu).unwrap()
    };
    let (whole, part) = (draw(&config), draw(&part));
    assert!(part.len() < whole.len());
    for (name, tensor) in &part {
        assert_eq!(values(tensor), values(&whole[name]), "{name}");
    }
}

#[test]
fn drawn_networks_give_finite_poses_near_the_identity() {
    let config = tiny();
    let model = LoadedModel::untrained(&config, 1).unwrap();
    assert!(!model.trained);
    assert!(matches!(&model.metadata.provenance, Provenance::Untrained { seed: 1, .. }));
    let mut state = model.network.initial_state();
    let mut earlier = None;
    for t in 0..4 {
        let fused = model.network.step(&frame_for(&config, t), &mut state).unwrap().fused.unwrap();
        assert_eq!(fused.log_variance, None);
        for (value, identity) in fused.rotation_raw.iter().zip(config.rotation.identity()) {
            assert!((value - f64::from(*identity)).abs() < 0.9, "{:?}", fused.rotation_raw);
        }
        assert!(fused.translation_m.iter().all(|v| v.is_finite() && v.abs() < 10.0));
        assert_ne!(earlier.replace(fused.clone()), Some(fused), "frames must matter");
    }
}

#[test]
fn he_normal_convolutions_have_their_deviation() {
    let config = tiny();
    let checkpoint = untrained::checkpoint(&config, 2, Preprocessing::default()).unwrap();
    let tensors = checkpoint.into_tensors(&Device::Cpu).unwrap();
    let tensor = &tensors["rcnn2.res5.0.conv2.weight"];
    let fan_in: usize = tensor.dims()[1..].iter().product();
    let values = values(tensor);
    let n = values.len() as f64;
    let mean = values.iter().map(|v| f64::from(*v)).sum::<f64>() / n;
    let variance = values.iter().map(|v| (f64::from(*v) - mean).powi(2)).sum::<f64>() / n;
    let expected = 2.0 / fan_in as f64;
    // Standard errors: sigma / sqrt(n) and sigma^2 sqrt(2 / n); five of each.
    assert!(mean.abs() < 5.0 * (expected / n).sqrt(), "{mean}");
    assert!((variance - expected).abs() < 5.0 * expected * (2.0 / n).sqrt(), "{variance} {expected}");
}

#[test]
fn every_preset_but_the_largest_runs() {
    for preset in PRESETS.iter().filter(|preset| **preset != "grnet") {
        // At a small width, so that the test is quick; the shapes' relations are those of the preset.
        let config = NetworkConfig { width: 0.125, ..NetworkConfig::preset(preset).unwrap() };
        let model = LoadedModel::untrained(&config, 1).unwrap();
        let mut state = model.network.initial_state();
        let output = model.network.step(&frame_for(&config, 0), &mut state).unwrap();
        let exist = (output.relative.is_some(), output.global.is_some(), output.fused.is_some());
        let Branches { relative, global, fusion } = config.branches;
        assert_eq!(exist, (relative, global, fusion), "{preset}");
    }
}
