//! Checkpoint files: round trips, parts, and every way in which a file can be wrong.

mod common;

use std::collections::HashMap;
use std::error::Error as _;
use std::path::{Path, PathBuf};

use common::{frame_for, tiny, values, weights};
use grnet_model::candle_core::{Device, Tensor};
use grnet_model::{
    Branches, Checkpoint, CheckpointError, CheckpointMetadata, Heads, Kind, LoadedModel, NetworkConfig,
    Preprocessing, Provenance, RigidTransform, SceneInfo, Storage, untrained,
};
use serde_json::json;

fn trained(config: &NetworkConfig) -> Checkpoint {
    let provenance = Provenance::Trained([("run".to_owned(), json!({"epochs": 3}))].into());
    let heads = Heads::all_of(config);
    let metadata = CheckpointMetadata {
        scene: Some(SceneInfo { id: "kitchen-1".into(), name: "Kitchen".into() }),
        map_from_world: Some(RigidTransform {
            translation_m: [0.1, -2.000000000000001, 1.0 / 3.0],
            rotation_xyzw: [0.0, 0.6, 0.0, 0.8],
        }),
        ..CheckpointMetadata::complete(config.clone(), Preprocessing::default(), heads, provenance)
    };
    Checkpoint::new(metadata, &weights(config)).unwrap()
}

fn folder() -> tempfile::TempDir {
    tempfile::tempdir().unwrap()
}

/// The message with its causes, as a binary would print it.
fn chain(error: &CheckpointError) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        text += &format!(": {error}");
        cause = error.source();
    }
    text
}

/// Writes a safetensors file with any metadata entry and any f32 tensors.
fn write_raw(path: &Path, entry: Option<&str>, tensors: &HashMap<String, Tensor>) {
    let metadata = entry.map(|json| HashMap::from([("grnet".to_owned(), json.to_owned())]));
    let bytes: Vec<(String, Vec<usize>, Vec<u8>)> = tensors
        .iter()
        .map(|(name, t)| {
            (name.clone(), t.dims().to_vec(), values(t).iter().flat_map(|v| v.to_le_bytes()).collect())
        })
        .collect();
    let views = bytes.iter().map(|(name, shape, bytes)| {
        let view = safetensors::tensor::TensorView::new(safetensors::Dtype::F32, shape.clone(), bytes);
        (name.clone(), view.unwrap())
    });
    std::fs::write(path, safetensors::serialize(views, metadata).unwrap()).unwrap();
}

/// A file whose metadata and tensors were edited after the fact; the error of loading it.
fn error_after(
    edit_metadata: impl FnOnce(&mut serde_json::Value),
    edit_tensors: impl FnOnce(&mut HashMap<String, Tensor>),
) -> (PathBuf, CheckpointError) {
    let folder = folder();
    let path = folder.path().join("edited.safetensors");
    let checkpoint = trained(&tiny());
    let mut metadata = serde_json::to_value(checkpoint.metadata()).unwrap();
    let mut tensors = checkpoint.into_tensors(&Device::Cpu).unwrap();
    edit_metadata(&mut metadata);
    edit_tensors(&mut tensors);
    write_raw(&path, Some(&metadata.to_string()), &tensors);
    let error = Checkpoint::load(&path).unwrap_err();
    let message = chain(&error);
    assert!(message.contains("edited.safetensors"), "the file must be named: {message}");
    (path, error)
}

#[test]
fn a_file_gives_back_what_was_saved() {
    let folder = folder();
    let path = folder.path().join("a.safetensors");
    let saved = trained(&tiny());
    saved.save(&path).unwrap();
    let loaded = Checkpoint::load(&path).unwrap();
    assert_eq!(loaded.metadata(), saved.metadata());
    let (saved, loaded) =
        (saved.into_tensors(&Device::Cpu).unwrap(), loaded.into_tensors(&Device::Cpu).unwrap());
    assert_eq!(saved.len(), loaded.len());
    for (name, tensor) in &saved {
        assert_eq!(values(tensor), values(&loaded[name]), "{name}");
        assert_eq!(tensor.dims(), loaded[name].dims(), "{name}");
    }
}

#[test]
fn half_precision_halves_the_file_and_keeps_the_weights_near() {
    let folder = folder();
    let (single, half) = (folder.path().join("f32"), folder.path().join("f16"));
    let checkpoint = trained(&tiny());
    checkpoint.save(&single).unwrap();
    let converted = checkpoint.clone().with_storage(Storage::F16).unwrap();
    assert_ne!(converted.content_hash(), checkpoint.content_hash());
    converted.save(&half).unwrap();
    let size = |path: &Path| std::fs::metadata(path).unwrap().len() as f64;
    assert!(size(&half) < 0.6 * size(&single));
    let loaded = Checkpoint::load(&half).unwrap().into_tensors(&Device::Cpu).unwrap();
    for (name, tensor) in checkpoint.into_tensors(&Device::Cpu).unwrap() {
        for (exact, stored) in values(&tensor).iter().zip(values(&loaded[&name])) {
            assert!((exact - stored).abs() <= exact.abs() * 5e-4 + 1e-7, "{name}: {exact} {stored}");
        }
    }
}

#[test]
fn a_weight_beyond_half_precision_is_refused() {
    let config = tiny();
    let mut tensors = weights(&config);
    let name = "fcfl.fc4.bias";
    tensors.insert(name.into(), Tensor::new(&[0.0f32, 1e6, 0.0], &Device::Cpu).unwrap());
    let metadata = trained(&config).metadata().clone();
    let error = Checkpoint::new(metadata, &tensors).unwrap().with_storage(Storage::F16).unwrap_err();
    assert!(error.to_string().contains(name), "{error}");
}

#[test]
fn saving_replaces_the_file_and_leaves_nothing_beside_it() {
    let folder = folder();
    let path = folder.path().join("a.safetensors");
    std::fs::write(&path, "old").unwrap();
    trained(&tiny()).save(&path).unwrap();
    trained(&tiny()).save(&path).unwrap();
    let names: Vec<_> = std::fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert_eq!(names, ["a.safetensors"]);
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        let probe = folder.path().join("probe");
        std::fs::write(&probe, "").unwrap();
        let mode = |path: &Path| std::fs::metadata(path).unwrap().permissions().mode();
        assert_eq!(mode(&path), mode(&probe), "a checkpoint has the permissions of any new file");
    }
    let missing = folder.path().join("missing/a.safetensors");
    let error = trained(&tiny()).save(&missing).unwrap_err();
    assert!(error.to_string().contains("missing/a.safetensors"), "{error}");
}

#[test]
fn trunk_and_scene_make_the_complete_model_again() {
    let folder = folder();
    let at = |name: &str| folder.path().join(name);
    let config = tiny();
    let complete = trained(&config);
    complete.save(&at("complete")).unwrap();
    let (trunk, scene) = complete.split().unwrap();
    assert_eq!(scene.metadata().trunk_hash.as_deref(), Some(trunk.content_hash()));
    assert_eq!((trunk.metadata().kind, scene.metadata().kind), (Kind::Trunk, Kind::Scene));
    assert_eq!(trunk.metadata().scene, None);
    trunk.save(&at("trunk")).unwrap();
    scene.save(&at("scene")).unwrap();

    let whole = LoadedModel::load(&at("complete"), None).unwrap();
    let merged = LoadedModel::load(&at("trunk"), Some(&at("scene"))).unwrap();
    let swapped = LoadedModel::load(&at("complete"), Some(&at("scene"))).unwrap();
    assert_eq!(whole.model_hash, merged.model_hash);
    assert_eq!(whole.metadata, merged.metadata);
    assert_eq!(whole.metadata, swapped.metadata);
    assert!(merged.trained && merged.metadata.scene.is_some());
    let image = frame_for(&config, 0);
    let pose = |model: &LoadedModel| model.network.step(&image, &mut model.network.initial_state()).unwrap();
    assert_eq!(pose(&whole), pose(&merged));

    let alone = LoadedModel::load(&at("trunk"), None).unwrap();
    assert_eq!(pose(&alone).relative, pose(&whole).relative);
    assert_eq!((pose(&alone).global, pose(&alone).fused), (None, None));
    assert_ne!(alone.model_hash, whole.model_hash);

    let error = LoadedModel::load(&at("scene"), None).unwrap_err();
    assert!(error.to_string().contains("is a scene file"), "{error}");
    let error = LoadedModel::load(&at("trunk"), Some(&at("trunk"))).unwrap_err();
    assert!(error.to_string().contains("where a scene file is needed"), "{error}");
    let error = LoadedModel::load(&at("scene"), Some(&at("scene"))).unwrap_err();
    assert!(error.to_string().contains("where a trunk or a complete checkpoint is needed"), "{error}");
}

#[test]
fn a_scene_says_how_uncertain_the_trunks_motion_is_in_its_place() {
    let folder = folder();
    let at = |name: &str| folder.path().join(name);
    let config = tiny();
    let complete = trained(&config);
    let shift = [2.5, -1.0, 0.5, 3.0, 0.0, 4.25];
    let shifted = complete.clone().with_metadata(|m| m.motion_log_variance_shift = Some(shift)).unwrap();
    let (trunk, scene) = shifted.split().unwrap();
    assert_eq!(trunk.metadata().motion_log_variance_shift, None, "a trunk knows no place");
    complete.save(&at("complete")).unwrap();
    trunk.save(&at("trunk")).unwrap();
    scene.save(&at("scene")).unwrap();

    let output = |trunk: &str, scene: Option<&str>| {
        let model = LoadedModel::load(&at(trunk), scene.map(at).as_deref()).unwrap();
        let output = model.network.step(&frame_for(&config, 0), &mut model.network.initial_state()).unwrap();
        ((model.model_hash, model.trunk_hash), output)
    };
    let (hashes, before) = output("complete", None);
    let (shifted_hashes, after) = output("trunk", Some("scene"));
    assert_eq!(hashes, shifted_hashes, "the tensors are the same");
    assert_eq!((&before.global, &before.fused), (&after.global, &after.fused));
    let (before, after) = (before.relative.unwrap(), after.relative.unwrap());
    assert_eq!((before.translation_m, &before.rotation_raw), (after.translation_m, &after.rotation_raw));
    let (before, after) = (before.log_variance.unwrap(), after.log_variance.unwrap());
    for (i, shift) in shift.iter().enumerate() {
        assert!((after[i] - before[i] - shift).abs() < 1e-5, "{before:?} {after:?}");
    }
    let alone = output("trunk", None).1.relative.unwrap();
    assert_eq!(alone.log_variance, Some(before), "without the place, what the trunk says");
}

#[test]
fn a_scene_of_another_trunk_is_refused_with_both_hashes() {
    let (trunk, _) = trained(&tiny()).split().unwrap();
    let other = untrained::checkpoint(&tiny(), 1, Preprocessing::default()).unwrap();
    let (other_trunk, scene) = other.split().unwrap();
    let error = Checkpoint::merge(trunk.clone(), scene).unwrap_err().to_string();
    assert!(error.contains(trunk.content_hash()), "{error}");
    assert!(error.contains(other_trunk.content_hash()), "{error}");
}

#[test]
fn parts_that_disagree_about_themselves_are_refused() {
    let (trunk, scene) = trained(&tiny()).split().unwrap();
    let renormalised = scene.clone().with_metadata(|m| m.preprocessing.mean = [0.5; 3]).unwrap();
    let error = Checkpoint::merge(trunk.clone(), renormalised).unwrap_err().to_string();
    assert!(error.contains("differ in the preprocessing"), "{error}");
    let longer = scene.with_metadata(|m| m.network.k = 9).unwrap();
    let error = Checkpoint::merge(trunk, longer).unwrap_err().to_string();
    assert!(error.contains("differ in the network"), "{error}");
}

#[test]
fn an_untrained_part_makes_the_whole_untrained() {
    let drawn = untrained::checkpoint(&tiny(), 5, Preprocessing::default()).unwrap();
    let (trunk, scene) = drawn.split().unwrap();
    let record = |what: &str| Provenance::Trained([("stage".to_owned(), json!(what))].into());
    let trained_trunk = trunk.clone().with_metadata(|m| m.provenance = record("one")).unwrap();
    let trained_scene = scene.clone().with_metadata(|m| m.provenance = record("two")).unwrap();
    for (trunk, scene, trained) in [
        (&trained_trunk, &scene, false),
        (&trunk, &trained_scene, false),
        (&trained_trunk, &trained_scene, true),
    ] {
        let merged = Checkpoint::merge(trunk.clone(), scene.clone()).unwrap();
        assert_eq!(LoadedModel::from_checkpoint(merged, &Device::Cpu).unwrap().trained, trained);
    }
    let both = Checkpoint::merge(trained_trunk, trained_scene).unwrap();
    let expected = [("trunk", json!({"stage": "one"})), ("scene", json!({"stage": "two"}))];
    let expected = Provenance::Trained(expected.map(|(k, v)| (k.to_owned(), v)).into());
    assert_eq!(both.metadata().provenance, expected);
}

#[test]
fn a_trunk_without_rcnn1_needs_a_scene() {
    let config =
        NetworkConfig { branches: Branches { relative: false, global: true, fusion: false }, ..tiny() };
    let (trunk, scene) = trained(&config).split().unwrap();
    let error = LoadedModel::from_checkpoint(trunk.clone(), &Device::Cpu).unwrap_err();
    assert!(error.to_string().contains("without RCNN1"), "{error}");
    let merged = Checkpoint::merge(trunk, scene).unwrap();
    assert_eq!(merged, trained(&config));
    let relative_only =
        NetworkConfig { branches: Branches { relative: true, global: false, fusion: false }, ..tiny() };
    let error = trained(&relative_only).split().unwrap_err();
    assert!(error.to_string().contains("no global branch"), "{error}");
}

#[test]
fn missing_surplus_and_misshapen_tensors_are_listed_together() {
    let (_, error) = error_after(
        |_| {},
        |tensors| {
            tensors.remove("fcfl.fc3.weight").unwrap();
            let bias = tensors.remove("fcfl.fc4.bias").unwrap();
            tensors.insert("fcfl.fc6.bias".into(), bias);
            let wrong = Tensor::zeros((5, 5), grnet_model::candle_core::DType::F32, &Device::Cpu).unwrap();
            tensors.insert("rcnn1.fc1.weight".into(), wrong);
        },
    );
    let message = error.to_string();
    for part in [
        "2 missing: fcfl.fc3.weight [16, 24], fcfl.fc4.bias [3]",
        "1 not of this network: fcfl.fc6.bias [3]",
        "1 of another shape: rcnn1.fc1.weight is [5, 5], [10, 12] expected",
    ] {
        assert!(message.contains(part), "{part} not in: {message}");
    }
}

#[test]
fn a_long_list_of_missing_tensors_is_capped() {
    let (_, error) = error_after(|_| {}, |tensors| tensors.retain(|name, _| !name.starts_with("cnn1.layer")));
    let message = error.to_string();
    assert!(message.contains(" more") && message.contains("cnn1.layer1.0.conv1.weight"), "{message}");
    assert!(message.len() < 1000, "{message}");
}

#[test]
fn a_changed_weight_is_found_by_its_hash() {
    let (_, error) = error_after(
        |_| {},
        |tensors| {
            tensors.insert("fcfl.fc4.bias".into(), Tensor::new(&[0.0f32, 0.5, 0.0], &Device::Cpu).unwrap());
        },
    );
    assert!(matches!(error, CheckpointError::Hash { .. }), "{error}");
    assert!(error.to_string().contains(trained(&tiny()).content_hash()), "{error}");
}

#[test]
fn weights_that_are_no_numbers_are_named() {
    for (name, bad) in [("fcfl.fc4.bias", f32::NAN), ("fcfl.fc4.bias", f32::INFINITY)] {
        let (_, error) = error_after(
            |_| {},
            |tensors| {
                tensors.insert(name.into(), Tensor::new(&[0.0, bad, 0.0], &Device::Cpu).unwrap());
            },
        );
        assert!(error.to_string().contains(name), "{error}");
    }
    let (_, error) = error_after(
        |_| {},
        |tensors| {
            let variance = tensors["cnn1.bn1.running_var"].neg().unwrap();
            tensors.insert("cnn1.bn1.running_var".into(), variance);
        },
    );
    assert!(error.to_string().contains("cnn1.bn1.running_var"), "{error}");
}

#[test]
fn other_schemas_and_unknown_fields_are_named() {
    let (_, error) = error_after(|m| m["schema"] = json!(2), |_| {});
    assert!(error.to_string().contains("schema 2; this version reads schema 1"), "{error}");
    let (_, error) = error_after(|m| drop(m.as_object_mut().unwrap().remove("schema")), |_| {});
    assert!(error.to_string().contains("schema (none)"), "{error}");
    let (_, error) = error_after(|m| m["colour"] = json!("red"), |_| {});
    assert!(chain(&error).contains("unknown field `colour`"), "{}", chain(&error));
    let (_, error) = error_after(|m| m["network"]["depth"] = json!(50), |_| {});
    assert!(chain(&error).contains("unknown field `depth`"), "{}", chain(&error));
    let (_, error) = error_after(|m| m["provenance"] = json!({"state": "untrained", "seed": 1}), |_| {});
    assert!(chain(&error).contains("generator"), "{}", chain(&error));
}

#[test]
fn metadata_that_contradicts_itself_is_refused() {
    type Edit = fn(&mut serde_json::Value);
    let edits: [(Edit, &str); 10] = [
        (|m| m["network"]["k"] = json!(0), "`k` is 0"),
        (|m| m["trunk_hash"] = json!("00"), "must not"),
        (|m| m["kind"] = json!("scene"), "trunk_hash"),
        (|m| m["preprocessing"]["std"] = json!([0.2, 0.0, 0.2]), "preprocessing.std"),
        (|m| m["map_from_world"]["rotation_xyzw"] = json!([0.0, 0.0, 0.0, 0.5]), "unit quaternion"),
        (|m| m["network"]["log_variance"] = json!(false), "heads lists"),
        (|m| m["network"]["branches"]["global"] = json!(false), "fusion only with both"),
        (|m| m["motion_log_variance_shift"] = json!([0, 0, 0, 0, 0, 17]), "within 16 of 0"),
        (
            |m| {
                m["motion_log_variance_shift"] = json!([0, 0, 0, 0, 0, 1]);
                m["kind"] = json!("trunk");
                m["heads"]["global"] = json!({"pose": false, "log_variance": false});
                m["heads"]["fused"] = m["heads"]["global"].clone();
            },
            "in a trunk file",
        ),
        (
            |m| {
                m["camera"] = json!({"width_px": 640, "height_px": 480, "fx_px": -525.0, "fy_px": 525.0,
                    "cx_px": 319.5, "cy_px": 239.5, "distortion": "none"});
            },
            "focal lengths",
        ),
    ];
    for (edit, expected) in edits {
        let (_, error) = error_after(edit, |_| {});
        assert!(error.to_string().contains(expected), "{expected} not in: {error}");
    }
}

#[test]
fn foreign_truncated_and_absent_files_are_named() {
    let folder = folder();
    let at = |name: &str| folder.path().join(name);
    write_raw(&at("resnet50.safetensors"), None, &weights(&tiny()));
    let error = Checkpoint::load(&at("resnet50.safetensors")).unwrap_err().to_string();
    assert!(error.contains("resnet50.safetensors") && error.contains("cnn1.bn1.bias"), "{error}");

    trained(&tiny()).save(&at("whole")).unwrap();
    let bytes = std::fs::read(at("whole")).unwrap();
    for length in [0, 7, 8, 100, bytes.len() / 2, bytes.len() - 1] {
        std::fs::write(at("cut"), &bytes[..length]).unwrap();
        let error = Checkpoint::load(&at("cut")).unwrap_err();
        assert!(matches!(error, CheckpointError::NotSafetensors { .. }), "{error}");
        assert!(error.to_string().contains("cut"), "{error}");
    }
    let error = Checkpoint::load(&at("absent")).unwrap_err();
    assert!(matches!(error, CheckpointError::Io { .. }) && error.to_string().contains("absent"), "{error}");
    let error = chain(&Checkpoint::load(folder.path()).unwrap_err());
    assert!(error.contains("not a regular file"), "{error}");
}
