//! What a run folder holds, refuses and survives, within one process.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use candle_core::{Device, Tensor};
use grnet_train::run::{LogEntry, LogKind, RunError, RunFolder, RunIdentity, State, StateTensor};
use serde_json::json;

fn identity() -> RunIdentity {
    RunIdentity {
        config_toml: "# as given\nepochs = 3\n".into(),
        seed: u64::MAX,
        fingerprint: "f00d".into(),
        threads: 2,
        details: BTreeMap::new(),
    }
}

fn state(step: u64) -> State {
    // NaN with a payload, minus zero and the smallest number: all are to come back bit by bit.
    let odd = [0x7fc0_1234, 0x8000_0000, 1, 0x3f80_0000 + step as u32].map(f32::from_bits);
    let numbers = [
        ("adam.steps", json!(u64::MAX - step)),
        ("best", json!(0.1 + 0.2)),
        // Parsers that are a little off miss this one.
        ("hard", json!(1.2345678901234567e-300)),
        ("stream", json!({ "seed": [1, 2, 3], "position": -5 })),
    ];
    State {
        step,
        stage: 2,
        tensors: BTreeMap::from([
            ("a.weight".into(), StateTensor { shape: vec![2, 2], values: odd.to_vec() }),
            ("empty".into(), StateTensor { shape: vec![0, 3], values: vec![] }),
            ("scalar".into(), StateTensor { shape: vec![], values: vec![7.0] }),
        ]),
        numbers: numbers.map(|(name, value)| (name.to_owned(), value)).into(),
    }
}

/// As text, in which NaN equals itself and -0 is not 0.
fn shown(state: &State) -> String {
    let bits = |tensor: &StateTensor| {
        (tensor.shape.clone(), tensor.values.iter().map(|v| v.to_bits()).collect::<Vec<_>>())
    };
    let tensors: BTreeMap<_, _> = state.tensors.iter().map(|(name, tensor)| (name, bits(tensor))).collect();
    format!("{} {} {tensors:?} {:?}", state.step, state.stage, state.numbers)
}

fn text(error: &RunError) -> String {
    error.to_string()
}

fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    names
}

#[test]
fn a_state_comes_back_bit_by_bit() {
    let parent = tempfile::tempdir().unwrap();
    let path = parent.path().join("runs/first");
    let run = RunFolder::create(&path, &identity()).unwrap();
    assert_eq!(run.load_state().unwrap(), None);
    run.save_state(&state(1)).unwrap();
    run.save_state(&state(2)).unwrap();
    assert_eq!(shown(&run.load_state().unwrap().unwrap()), shown(&state(2)));
    drop(run);
    let run = RunFolder::resume(&path, &identity()).unwrap();
    assert_eq!(shown(&run.load_state().unwrap().unwrap()), shown(&state(2)));
    assert_eq!(RunFolder::config_of(&path).unwrap(), identity().config_toml);
    let record: serde_json::Value =
        serde_json::from_slice(&fs::read(path.join("run.json")).unwrap()).unwrap();
    assert_eq!((&record["seed"], &record["fingerprint"]), (&json!(u64::MAX), &json!("f00d")));
    assert_eq!(
        names(&path),
        [
            "config.toml",
            "log.jsonl",
            "run.json",
            "run.lock",
            "state.previous.safetensors",
            "state.safetensors"
        ]
    );
}

#[test]
fn a_state_that_contradicts_itself_is_not_saved() {
    let folder = tempfile::tempdir().unwrap();
    let run = RunFolder::create(folder.path(), &identity()).unwrap();
    run.save_state(&state(1)).unwrap();
    let mut wrong = state(2);
    wrong.tensors.insert("b".into(), StateTensor { shape: vec![3], values: vec![0.0; 4] });
    let error = run.save_state(&wrong).unwrap_err();
    assert!(text(&error).contains("tensor b has 4 values") && text(&error).contains("asks for 3"), "{error}");
    assert_eq!(run.load_state().unwrap().unwrap().step, 1);
}

#[test]
fn a_flipped_bit_or_a_missing_end_is_never_trained_on() {
    let folder = tempfile::tempdir().unwrap();
    let run = RunFolder::create(folder.path(), &identity()).unwrap();
    run.save_state(&state(1)).unwrap();
    run.save_state(&state(2)).unwrap();
    let path = folder.path().join("state.safetensors");
    let good = fs::read(&path).unwrap();
    let loaded = |bytes: &[u8]| {
        fs::write(&path, bytes).unwrap();
        let mut warning = None;
        let state = run.load_state_with(|text| warning = Some(text)).unwrap().unwrap();
        (shown(&state), warning)
    };
    let mut fallen_back = 0;
    for at in 0..good.len() {
        let mut bytes = good.clone();
        bytes[at] ^= 0x04;
        match loaded(&bytes) {
            // Some bytes of the header, such as its padding, mean nothing.
            (found, None) => assert_eq!(found, shown(&state(2)), "byte {at}"),
            (found, Some(warning)) => {
                assert_eq!(found, shown(&state(1)), "byte {at}");
                assert!(warning.contains("state.safetensors is damaged"), "{warning}");
                assert!(warning.contains("step 1 (state.previous.safetensors)"), "{warning}");
                fallen_back += 1;
            }
        }
    }
    assert!(fallen_back > good.len() * 9 / 10, "{fallen_back} of {}", good.len());
    for length in 0..good.len() {
        let (found, warning) = loaded(&good[..length]);
        assert!(found == shown(&state(1)) && warning.is_some(), "{length} bytes");
    }
    fs::write(folder.path().join("state.previous.safetensors"), b"no").unwrap();
    let error = text(&run.load_state().unwrap_err());
    assert!(error.contains("state.safetensors is damaged"), "{error}");
    assert!(error.contains("state.previous.safetensors is damaged"), "{error}");
    fs::remove_file(folder.path().join("state.previous.safetensors")).unwrap();
    let error = text(&run.load_state().unwrap_err());
    assert!(!error.contains("previous") && error.contains("restore one of them"), "{error}");
}

#[test]
fn every_moment_of_a_save_leaves_a_good_state() {
    let folder = tempfile::tempdir().unwrap();
    let run = RunFolder::create(folder.path(), &identity()).unwrap();
    for step in 1..=3 {
        run.save_state(&state(step)).unwrap();
    }
    let (newest, previous) =
        (folder.path().join("state.safetensors"), folder.path().join("state.previous.safetensors"));
    let partial = folder.path().join("state.safetensors.partial");
    let step = || run.load_state_with(|warning| panic!("{warning}")).unwrap().map(|state| state.step);
    // While the new file is written.
    fs::write(&partial, b"half").unwrap();
    assert_eq!(step(), Some(3));
    // Between the two renames.
    fs::rename(&newest, &previous).unwrap();
    assert_eq!(step(), Some(3));
    // And on from there.
    run.save_state(&state(4)).unwrap();
    assert_eq!((step(), partial.exists()), (Some(4), false));
    fs::remove_file(&newest).unwrap();
    assert_eq!(step(), Some(3));
    // The same in the first save.
    fs::remove_file(&previous).unwrap();
    fs::write(&partial, b"half").unwrap();
    assert_eq!(step(), None);
    run.save_state(&state(1)).unwrap();
    assert_eq!(step(), Some(1));
}

#[test]
fn a_used_folder_is_refused_and_left_alone() {
    let parent = tempfile::tempdir().unwrap();
    let path = parent.path().join("run");
    drop(RunFolder::create(&path, &identity()).unwrap());
    let error = RunFolder::create(&path, &identity()).unwrap_err();
    assert!(matches!(error, RunError::HoldsRun { .. }) && text(&error).contains("--resume"), "{error}");

    let foreign = parent.path().join("foreign");
    fs::create_dir(&foreign).unwrap();
    for (file, content) in [("thesis.tex", "mine"), ("config.toml", "another = 1")] {
        fs::write(foreign.join(file), content).unwrap();
        let error = RunFolder::create(&foreign, &identity()).unwrap_err();
        assert!(text(&error).contains(file), "{error}");
        assert_eq!(names(&foreign), [file]);
        fs::remove_file(foreign.join(file)).unwrap();
    }
    let error = RunFolder::resume(&foreign, &identity()).unwrap_err();
    assert!(matches!(error, RunError::NoRun { .. }), "{error}");
    assert_eq!(names(&foreign), Vec::<String>::new());

    // What a start that was killed before run.json was there leaves behind is taken over.
    fs::write(foreign.join("config.toml"), identity().config_toml).unwrap();
    fs::write(foreign.join("run.json.partial"), "{").unwrap();
    fs::write(foreign.join("log.jsonl"), "").unwrap();
    RunFolder::create(&foreign, &identity()).unwrap();
}

#[test]
fn another_run_is_not_resumed() {
    let folder = tempfile::tempdir().unwrap();
    drop(RunFolder::create(folder.path(), &identity()).unwrap());
    let error = |identity: RunIdentity| text(&RunFolder::resume(folder.path(), &identity).unwrap_err());
    let found = error(RunIdentity { config_toml: "# as given\nepochs = 4\n".into(), ..identity() });
    assert!(found.contains("- 2: epochs = 3\n  + 2: epochs = 4"), "{found}");
    let found = error(RunIdentity { fingerprint: "beef".into(), ..identity() });
    assert!(found.contains("wrong data set") && found.contains("f00d") && found.contains("beef"), "{found}");
    let found = error(RunIdentity { threads: 1, ..identity() });
    assert!(found.contains("RAYON_NUM_THREADS=2") && !found.contains("seed"), "{found}");

    let path = folder.path().join("run.json");
    let record = fs::read_to_string(&path).unwrap();
    fs::write(&path, record.replace("\"schema\": 1", "\"schema\": 9")).unwrap();
    let found = error(identity());
    assert!(found.contains("schema is 9"), "{found}");
    fs::write(&path, &record[..record.len() / 2]).unwrap();
    let found = error(identity());
    assert!(found.contains("run.json") && found.contains("line"), "{found}");
    fs::write(&path, record).unwrap();
    RunFolder::resume(folder.path(), &identity()).unwrap();
}

#[test]
fn a_second_opening_is_refused_while_the_first_lives() {
    let folder = tempfile::tempdir().unwrap();
    let run = RunFolder::create(folder.path(), &identity()).unwrap();
    let error = RunFolder::resume(folder.path(), &identity()).unwrap_err();
    assert!(text(&error).contains(&format!("process {} is training in it", std::process::id())), "{error}");
    drop(run);
    RunFolder::resume(folder.path(), &identity()).unwrap();
}

fn entry(step: u64, loss: f64) -> LogEntry {
    let values = [("fused.translation_m", loss / 2.0), ("odd", f64::NEG_INFINITY)];
    LogEntry {
        step,
        stage: "one".into(),
        loss: Some(loss),
        lr: Some(1e-3),
        values: values.map(|(name, value)| (name.to_owned(), value)).into(),
        ..LogEntry::default()
    }
}

#[test]
fn the_log_is_json_whatever_the_numbers_are() {
    let folder = tempfile::tempdir().unwrap();
    let mut run = RunFolder::create(folder.path(), &identity()).unwrap();
    let told = [
        entry(1, 0.1 + 0.2),
        entry(2, f64::NAN),
        LogEntry { kind: LogKind::Event, message: Some("two\nlines".into()), ..entry(3, f64::INFINITY) },
    ];
    for entry in &told {
        run.log(entry).unwrap();
    }
    let lines = fs::read_to_string(folder.path().join("log.jsonl")).unwrap();
    let lines: Vec<serde_json::Value> = lines.lines().map(|l| serde_json::from_str(l).unwrap()).collect();
    assert_eq!(lines.len(), 3);
    assert_eq!((&lines[0]["loss"], &lines[1]["loss"]), (&json!(0.1 + 0.2), &json!("NaN")));
    assert_eq!((&lines[2]["loss"], &lines[2]["kind"]), (&json!("inf"), &json!("event")));
    assert_eq!(lines[0]["values"]["odd"], json!("-inf"));
    assert_eq!(lines[0].get("grad_norm"), None);
    assert_eq!(format!("{:?}", run.read_log().unwrap()), format!("{told:?}"));
}

#[test]
fn a_resumed_log_goes_on_from_the_resumed_step() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("log.jsonl");
    let mut run = RunFolder::create(folder.path(), &identity()).unwrap();
    for step in 1..=5 {
        run.log(&entry(step, step as f64)).unwrap();
    }
    drop(run);
    let whole = fs::read(&log).unwrap();
    // Torn by a kill; or filled up with zeros by a loss of power.
    for torn in [&b"{\"step\":6,\"sta"[..], &[0; 100], b""] {
        fs::write(&log, [&whole, torn].concat()).unwrap();
        let mut run = RunFolder::resume(folder.path(), &identity()).unwrap();
        run.truncate_log(3).unwrap();
        run.log(&entry(4, 40.0)).unwrap();
        let steps: Vec<_> = run.read_log().unwrap().iter().map(|e| (e.step, e.loss.unwrap())).collect();
        assert_eq!(steps, [(1, 1.0), (2, 2.0), (3, 3.0), (4, 40.0)]);
        run.truncate_log(0).unwrap();
        assert_eq!(fs::metadata(&log).unwrap().len(), 0);
    }
    fs::write(&log, [b"{}\n", &whole[..]].concat()).unwrap();
    let mut run = RunFolder::resume(folder.path(), &identity()).unwrap();
    let error = text(&run.truncate_log(3).unwrap_err());
    assert!(error.contains("log.jsonl:1 is not an entry") && error.contains("step"), "{error}");
}

#[test]
fn a_bad_batch_can_be_looked_at() {
    let folder = tempfile::tempdir().unwrap();
    let run = RunFolder::create(folder.path(), &identity()).unwrap();
    let images = Tensor::new(&[[0.5f32, f32::NAN], [1.0, -2.0]], &Device::Cpu).unwrap();
    let poses = Tensor::new(&[1.0f64, 2.0], &Device::Cpu).unwrap();
    let frames = ["seq-01/frame-000007".to_owned()];
    let values = BTreeMap::from([("loss".to_owned(), f64::NAN)]);
    let path = run.save_bad_batch(12, &frames, &images, &[("poses", &poses)], &values).unwrap();
    let tensors = candle_core::safetensors::load(&path, &Device::Cpu).unwrap();
    let found: Vec<f32> = tensors["images"].flatten_all().unwrap().to_vec1().unwrap();
    assert!(found[1].is_nan() && found[3] == -2.0);
    assert_eq!(tensors["poses"].to_vec1::<f64>().unwrap(), [1.0, 2.0]);
    let described: serde_json::Value =
        serde_json::from_slice(&fs::read(path.with_extension("json")).unwrap()).unwrap();
    assert_eq!(described["step"], 12);
    assert_eq!(described["names"], json!(frames));
    assert_eq!(described["values"], json!({ "loss": "NaN" }));
    let images = json!({ "shape": [2, 2], "not_finite": 1, "smallest": -2.0, "largest": 1.0 });
    assert_eq!(described["tensors"]["images"], images);
}

#[test]
fn curves_are_drawn_of_any_log() {
    let folder = tempfile::tempdir().unwrap();
    let mut run = RunFolder::create(folder.path(), &identity()).unwrap();
    let pictures = |run: &RunFolder| {
        run.draw_curves().unwrap();
        let svg = fs::read_to_string(folder.path().join("curves.svg")).unwrap();
        let png = image::open(folder.path().join("curves.png")).unwrap().into_rgb8();
        (svg, png)
    };
    let (svg, _) = pictures(&run);
    assert!(svg.contains("nothing is logged yet"), "{svg}");
    // An event alone, one entry, then gaps, a new stage, and numbers of every kind.
    run.log(&LogEntry { kind: LogKind::Event, stage: "one".into(), ..LogEntry::default() }).unwrap();
    pictures(&run);
    run.log(&entry(1, 0.0)).unwrap();
    pictures(&run);
    for (n, loss) in [f64::NAN, 3.0, f64::INFINITY, 1e300, -5.0, 0.0, 1e-300].into_iter().enumerate() {
        run.log(&entry(10 + 100 * n as u64, loss)).unwrap();
        run.log(&LogEntry { kind: LogKind::Valid, stage: "two".into(), ..entry(11 + 100 * n as u64, loss) })
            .unwrap();
    }
    run.log(&entry(u64::MAX, 1.0)).unwrap();
    let (svg, png) = pictures(&run);
    for part in ["held out", "learning rate", "translation error (m)", "not finite"] {
        assert!(svg.contains(part), "{part} is not in the picture");
    }
    assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
    assert_eq!(png.width(), 2 * 860);
    // The red of what is not finite.
    assert!(png.pixels().any(|pixel| pixel.0 == [0xc0, 0x1c, 0x28]));
}
