//! Files with the exact keys of torchvision, at full size and at an eighth of the width, and files that are something else.

use std::collections::HashMap;
use std::path::PathBuf;

use candle_core::{DType, Module};
use grnet_model::candle_nn::VarBuilder;
use grnet_model::resnet::Stage;
use half::{bf16, f16};
use safetensors::Dtype;
use safetensors::tensor::TensorView;

use super::*;

/// A file to be: name, element type, shape, bytes.
type Entries = Vec<(String, Dtype, Vec<usize>, Vec<u8>)>;

/// Keys and shapes of torchvision's `resnet50` with `stem` (64) channels after conv1, counters and classifier included.
fn torchvision(stem: usize) -> Vec<(String, Vec<usize>)> {
    let mut keys = Vec::new();
    fn conv_bn(
        keys: &mut Vec<(String, Vec<usize>)>,
        (conv, bn): (String, String),
        (out, inputs, kernel): (usize, usize, usize),
    ) {
        keys.push((format!("{conv}.weight"), vec![out, inputs, kernel, kernel]));
        for name in ["weight", "bias", "running_mean", "running_var"] {
            keys.push((format!("{bn}.{name}"), vec![out]));
        }
        keys.push((format!("{bn}.num_batches_tracked"), vec![]));
    }
    conv_bn(&mut keys, ("conv1".into(), "bn1".into()), (stem, 3, 7));
    let mut inputs = stem;
    for (layer, blocks) in [(1, 3), (2, 4), (3, 6), (4, 3)] {
        let planes = stem << (layer - 1);
        for block in 0..blocks {
            let name = |part: &str| format!("layer{layer}.{block}.{part}");
            conv_bn(&mut keys, (name("conv1"), name("bn1")), (planes, inputs, 1));
            conv_bn(&mut keys, (name("conv2"), name("bn2")), (planes, planes, 3));
            conv_bn(&mut keys, (name("conv3"), name("bn3")), (4 * planes, planes, 1));
            if block == 0 {
                conv_bn(&mut keys, (name("downsample.0"), name("downsample.1")), (4 * planes, inputs, 1));
            }
            inputs = 4 * planes;
        }
    }
    keys.push(("fc.weight".into(), vec![1000, inputs]));
    keys.push(("fc.bias".into(), vec![1000]));
    keys
}

/// The i-th value of a tensor: small, different between tensors, positive for a variance.
fn pattern(name: &str, i: usize) -> f32 {
    let seed: usize = name.bytes().map(usize::from).sum();
    let value = ((i * 7919 + seed * 104_729) % 1021) as f32 / 1021.0 - 0.5;
    if name.ends_with("running_var") { value + 1.0 } else { 0.25 * value }
}

fn entries(stem: usize, dtype: Dtype) -> Entries {
    let entry = |(name, shape): (String, Vec<usize>)| {
        let count: usize = shape.iter().product();
        if name.ends_with("num_batches_tracked") {
            return (name, Dtype::I64, shape, vec![0; 8]);
        }
        let values = (0..count).map(|i| pattern(&name, i));
        let bytes = match dtype {
            Dtype::F16 => values.flat_map(|v| f16::from_f32(v).to_le_bytes()).collect(),
            Dtype::BF16 => values.flat_map(|v| bf16::from_f32(v).to_le_bytes()).collect(),
            Dtype::F64 => values.flat_map(|v| f64::from(v).to_le_bytes()).collect(),
            _ => values.flat_map(f32::to_le_bytes).collect(),
        };
        (name, dtype, shape, bytes)
    };
    torchvision(stem).into_iter().map(entry).collect()
}

struct File {
    _folder: tempfile::TempDir,
    path: PathBuf,
}

impl File {
    fn of(entries: &Entries) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("weights.safetensors");
        let views = entries.iter().map(|(name, dtype, shape, bytes)| {
            (name.clone(), TensorView::new(*dtype, shape.clone(), bytes).unwrap())
        });
        safetensors::serialize_to_file(views, None, &path).unwrap();
        Self { _folder: folder, path }
    }
}

fn eighth() -> NetworkConfig {
    NetworkConfig { width: 0.125, ..NetworkConfig::grnet() }
}

fn refusal(entries: &Entries) -> ImportError {
    of_any_width(&File::of(entries).path, &eighth()).unwrap_err()
}

fn values(tensor: &Tensor) -> Vec<f32> {
    tensor.flatten_all().unwrap().to_vec1().unwrap()
}

#[test]
fn a_file_of_full_size_gives_every_tensor_its_place() {
    // Zeros with a mark in three places: the file is 51 MB all the same.
    let mark = [("conv1.weight", 1.5), ("layer4.0.conv1.weight", 3.0), ("layer4.2.bn3.bias", -2.0)];
    let entry = |(name, shape): (String, Vec<usize>)| {
        let (dtype, size) =
            if name.ends_with("num_batches_tracked") { (Dtype::I64, 8) } else { (Dtype::F16, 2) };
        let mut bytes = vec![0; size * shape.iter().product::<usize>()];
        if let Some((_, value)) = mark.iter().find(|(marked, _)| *marked == name) {
            let last = bytes.len() - 2;
            bytes[last..].copy_from_slice(&f16::from_f32(*value).to_le_bytes());
        }
        (name, dtype, shape, bytes)
    };
    let file = File::of(&torchvision(64).into_iter().map(entry).collect());
    let config = NetworkConfig::grnet();
    let tensors = resnet50(&file.path, &config).unwrap();
    let shapes: HashMap<String, Vec<usize>> =
        config.tensors().into_iter().map(|spec| (spec.name, spec.shape)).collect();
    for (name, tensor) in &tensors {
        assert_eq!(tensor.dims(), shapes[name], "{name}");
        assert_eq!(tensor.dtype(), DType::F32);
    }
    // 43 convolutions with their batch norms in CNN1, 10 in each Res5, five tensors each.
    assert_eq!(tensors.len(), 5 * (43 + 2 * 10));
    let last = |name: &str| *values(&tensors[name]).last().unwrap();
    assert_eq!(last("cnn1.conv1.weight"), 1.5);
    assert_eq!(last("rcnn2.res5.0.conv1.weight"), 3.0);
    assert_eq!(last("rcnn1.res5.0.conv1.weight"), 1.5);
    assert_eq!((last("rcnn1.res5.2.bn3.bias"), last("rcnn2.res5.2.bn3.bias")), (-2.0, -2.0));
    let tiled = values(&tensors["rcnn1.res5.0.conv1.weight"].get(511).unwrap());
    assert_eq!((tiled.len(), tiled[1023], tiled[2047]), (2048, 1.5, 1.5));
}

#[test]
fn every_value_arrives_in_each_element_type_and_behind_each_prefix() {
    for (dtype, tolerance) in [(Dtype::F32, 0.0), (Dtype::F16, 1e-3), (Dtype::BF16, 1e-2)] {
        for (prefix, slim) in [("", false), ("model.", true), ("module.", false), ("backbone.", true)] {
            let mut entries = entries(8, dtype);
            // A backbone without counters and classifier.
            entries.retain(|(name, ..)| {
                !slim || !(name.starts_with("fc.") || name.ends_with("num_batches_tracked"))
            });
            entries.iter_mut().for_each(|entry| entry.0 = format!("{prefix}{}", entry.0));
            let tensors = of_any_width(&File::of(&entries).path, &eighth()).unwrap();
            assert_eq!(tensors.len(), 5 * 63);
            for (name, tensor) in tensors {
                let origin = match name.strip_prefix("cnn1.") {
                    Some(rest) => rest.to_owned(),
                    None => name.replace("rcnn1.res5", "layer4").replace("rcnn2.res5", "layer4"),
                };
                if name.starts_with("rcnn1.res5.0.conv1.") || name.starts_with("rcnn1.res5.0.downsample.0.") {
                    continue; // tiled: below
                }
                for (i, value) in values(&tensor).into_iter().enumerate() {
                    let expected = pattern(&origin, i);
                    assert!((value - expected).abs() <= tolerance, "{name}[{i}]: {value}, {expected}");
                }
            }
        }
    }
}

#[test]
fn two_equal_frames_give_rcnn1_what_one_gives_rcnn2() {
    let config = eighth();
    let tensors = of_any_width(&File::of(&entries(8, Dtype::F32)).path, &config).unwrap();
    let tensors: HashMap<String, Tensor> = tensors.into_iter().collect();
    let vb = VarBuilder::from_tensors(tensors, DType::F32, &Device::Cpu);
    let (channels, planes) = (config.features_shape().0, config.res5_planes());
    let one = Stage::new(channels, planes, 3, 2, vb.pp("rcnn2.res5")).unwrap();
    let two = Stage::new(2 * channels, planes, 3, 2, vb.pp("rcnn1.res5")).unwrap();
    let count = channels * 5 * 4;
    let x: Vec<f32> = (0..count).map(|i| ((i * 37 % 101) as f32) / 50.0 - 1.0).collect();
    let x = Tensor::from_vec(x, (1, channels, 5, 4), &Device::Cpu).unwrap();
    let y = one.forward(&x).unwrap();
    let y_y = two.forward(&Tensor::cat(&[&x, &x], 1).unwrap()).unwrap();
    let largest = |t: &Tensor| values(t).into_iter().fold(0.0_f32, |a, v| a.max(v.abs()));
    assert!(largest(&y) > 0.1);
    assert!(largest(&(&y - y_y).unwrap()) < 1e-4 * largest(&y));
}

#[test]
fn branches_that_are_not_there_get_nothing() {
    let config = NetworkConfig { width: 0.125, ..NetworkConfig::rcnn2_only() };
    let tensors = of_any_width(&File::of(&entries(8, Dtype::F32)).path, &config).unwrap();
    assert_eq!(tensors.len(), 5 * 53);
    assert!(tensors.keys().all(|name| name.starts_with("cnn1.") || name.starts_with("rcnn2.res5.")));
}

#[test]
fn a_network_of_another_size_is_refused_before_the_file_is_read() {
    let nowhere = Path::new("/nowhere/weights.safetensors");
    let error = resnet50(nowhere, &NetworkConfig::grnet_small()).unwrap_err().to_string();
    assert!(error.contains("width = 0.25") && error.contains("preset `grnet`"), "{error}");
    let narrow = NetworkConfig { res5_channels: 1024, ..NetworkConfig::grnet() };
    let error = resnet50(nowhere, &narrow).unwrap_err().to_string();
    assert!(error.contains("res5_channels = 1024") && error.contains("2048"), "{error}");
    let error = resnet50(nowhere, &NetworkConfig::grnet()).unwrap_err();
    assert!(matches!(&error, ImportError::Io { .. }) && error.to_string().contains("/nowhere/"), "{error}");
}

#[test]
fn other_networks_are_refused_by_name() {
    let good = || entries(8, Dtype::F32);
    let without = |gone: &dyn Fn(&str) -> bool| -> Entries {
        good().into_iter().filter(|(name, ..)| !gone(name)).collect()
    };
    let extra = |entries: &mut Entries, name: &str, shape: &[usize]| {
        let bytes = vec![0; 4 * shape.iter().product::<usize>()];
        entries.push((name.into(), Dtype::F32, shape.to_vec(), bytes));
    };

    let error = refusal(&without(&|name| name == "layer3.5.bn3.bias")).to_string();
    assert!(error.contains("layer3.5.bn3.bias is missing") && !error.contains("more"), "{error}");

    let mut deep_stem = without(&|name| name == "conv1.weight");
    for (i, shape) in [(0, [4, 3, 3, 3]), (3, [4, 4, 3, 3]), (6, [8, 4, 3, 3])] {
        extra(&mut deep_stem, &format!("conv1.{i}.weight"), &shape);
    }
    let error = refusal(&deep_stem).to_string();
    assert!(error.contains("conv1.weight is missing") && error.contains("resnet50d"), "{error}");

    let mut deeper = good();
    extra(&mut deeper, "layer3.6.conv1.weight", &[32, 128, 1, 1]);
    let error = refusal(&deeper).to_string();
    assert!(error.contains("layer3.6.conv1.weight is surplus") && error.contains("deeper"), "{error}");

    let error = refusal(&without(&|name| name.contains("conv3") || name.contains("bn3"))).to_string();
    assert!(error.contains("ResNet-18") && error.contains("more"), "{error}");

    let error = refusal(&entries(16, Dtype::F32)).to_string();
    assert!(error.contains("bn1.bias has shape [16], expected [8]"), "{error}");

    let mut squeezing = good();
    extra(&mut squeezing, "layer1.0.se.fc1.weight", &[2, 32, 1, 1]);
    assert!(refusal(&squeezing).to_string().contains("layer1.0.se.fc1.weight is surplus"));

    let mut half_prefixed = good();
    half_prefixed
        .iter_mut()
        .filter(|e| e.0.starts_with("conv1"))
        .for_each(|e| e.0 = format!("model.{}", e.0));
    let error = refusal(&half_prefixed).to_string();
    assert!(error.contains("do not begin with \"model.\""), "{error}");
}

#[test]
fn bad_numbers_and_types_are_refused_by_tensor() {
    let error = refusal(&entries(8, Dtype::F64)).to_string();
    assert!(error.contains("is F64") && error.contains("bn1.bias"), "{error}");
    for (name, value, expected) in
        [("layer2.3.conv2.weight", f32::NAN, "finite"), ("layer4.0.bn1.running_var", -1.0, "at least 0")]
    {
        let mut entries = entries(8, Dtype::F32);
        let entry = entries.iter_mut().find(|entry| entry.0 == name).unwrap();
        entry.3[4..8].copy_from_slice(&value.to_le_bytes());
        let error = refusal(&entries).to_string();
        assert!(error.contains(name) && error.contains(expected), "{error}");
    }
}

#[test]
fn files_of_other_kinds_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("weights");
    let refusal = |bytes: &[u8]| {
        std::fs::write(&path, bytes).unwrap();
        of_any_width(&path, &eighth()).unwrap_err()
    };
    let error = refusal(b"PK\x03\x04archive/data.pkl");
    assert!(
        matches!(error, ImportError::Pickle { .. }) && error.to_string().contains("save_file"),
        "{error}"
    );
    assert!(matches!(refusal(&[0x80, 2, b'}', b'q']), ImportError::Pickle { .. }));
    assert!(matches!(refusal(b""), ImportError::NotSafetensors { .. }));
    let whole = std::fs::read(&File::of(&entries(8, Dtype::F16)).path).unwrap();
    assert!(matches!(refusal(&whole[..whole.len() - 1]), ImportError::NotSafetensors { .. }));
    assert!(matches!(refusal(&whole[..100]), ImportError::NotSafetensors { .. }));
}
