//! What is refused is refused by file, line, key and what is allowed.

use std::path::Path;

use grnet_config::{GrnetdConfig, Override, Pace};
use proptest::prelude::*;

fn refuse(text: &str, overrides: &[&str]) -> String {
    let overrides: Vec<_> = overrides.iter().map(|text| Override::parse(text).unwrap()).collect();
    GrnetdConfig::parse(text, Path::new("/etc/g.toml"), &overrides).unwrap_err().to_string()
}

fn accept(text: &str, overrides: &[&str]) -> GrnetdConfig {
    let overrides: Vec<_> = overrides.iter().map(|text| Override::parse(text).unwrap()).collect();
    GrnetdConfig::parse(text, Path::new("/etc/g.toml"), &overrides).unwrap()
}

#[test]
fn a_missing_file_is_named() {
    let error = GrnetdConfig::load(Path::new("/nowhere/g.toml"), &[]).unwrap_err().to_string();
    assert!(error.starts_with("cannot read the configuration /nowhere/g.toml: No such file"), "{error}");
}

#[test]
fn a_key_without_its_unit_is_refused_with_the_right_one() {
    let error = refuse("[publish]\n\ncreation_timeout = 20\n", &[]);
    assert_eq!(
        error,
        "/etc/g.toml:3:1: unknown key `publish.creation_timeout`; did you mean \
         `publish.creation_timeout_ms` (an integer from 1 to 1000 (milliseconds))?"
    );
}

#[test]
fn a_wrong_type_is_refused_with_what_is_allowed() {
    let error = refuse("[camera]\nname = 'a'\n[publish]\ncreation_timeout_ms = \"20 ms\"\n", &[]);
    assert_eq!(
        error,
        "/etc/g.toml:4:23: publish.creation_timeout_ms = \"20 ms\": invalid type: string \"20 ms\", expected \
         u64; allowed: an integer from 1 to 1000 (milliseconds)"
    );
}

#[test]
fn a_value_out_of_range_is_refused_with_its_place() {
    let error = refuse("[publish]\ncreation_timeout_ms = 0", &[]);
    assert!(
        error.starts_with("/etc/g.toml:2:23: publish.creation_timeout_ms = 0: out of range; all"),
        "{error}"
    );
    let error = refuse("[source]\nrate_hz = nan\n", &[]);
    assert!(error.starts_with("/etc/g.toml:2:11: source.rate_hz = nan: out of range"), "{error}");
    let error = refuse("[source]\npace = -1.5", &[]);
    assert!(error.contains("a factor greater than 0"), "{error}");
}

#[test]
fn a_wrong_choice_is_refused_with_the_choices() {
    let error = refuse("[source]\npace = 'fast'", &[]);
    assert!(error.contains("g.toml:2:8: source.pace = 'fast': ") && error.contains("\"max\""), "{error}");
    let error = refuse("[source]\nlayout = 'kiti'", &[]);
    assert!(error.contains("source.layout = 'kiti'") && error.contains("`kitti`"), "{error}");
}

#[test]
fn text_that_is_no_toml_is_refused_with_its_line() {
    let error = refuse("[camera]\nname = \"a\n", &[]);
    assert!(error.starts_with("/etc/g.toml:2:") && error.contains("not TOML"), "{error}");
    let error = refuse("[camera]\nname = 'a'\nname = 'b'\n", &[]);
    assert!(error.starts_with("/etc/g.toml:3:1: not TOML: duplicate key"), "{error}");
}

#[test]
fn a_section_that_is_no_section_is_refused() {
    let error = refuse("source = 'folder'", &[]);
    assert!(error.contains("`source` is a section"), "{error}");
    let error = refuse("[[source]]\nkind = 'folder'", &[]);
    assert!(error.contains("/etc/g.toml:1:3: ") && error.contains("`source` is a section"), "{error}");
}

#[test]
fn intrinsics_are_complete_or_absent() {
    let error = refuse("[source]\nloop = true\n[source.intrinsics]\nfx_px = 500\n", &[]);
    assert!(error.starts_with("/etc/g.toml:4:1: source.intrinsics."), "{error}");
    assert!(error.contains("complete or absent"), "{error}");
    let full = "[source.intrinsics]\nwidth_px = 640\nheight_px = 480\nfx_px = 500\nfy_px = 500.5\ncx_px = 320\n\
                cy_px = 240\ndistortion = 'plumb_bob'\n";
    let error = refuse(&format!("{full}coefficients = [0.1]"), &[]);
    assert!(error.contains("1 given, plumb_bob has 5"), "{error}");
    let config = accept(&format!("{full}coefficients = [0.1, 0, 0, 0, 0]"), &[]);
    assert_eq!(config.source.camera.unwrap().focal_px(), (500.0, 500.5));
}

#[test]
fn a_transform_needs_a_unit_quaternion() {
    let transform = |quaternion: &str| {
        format!(
            "[frames]\nbase_from_camera = {{ translation_m = [1, 2, 3], quaternion_xyzw = {quaternion} }}"
        )
    };
    let error = refuse(&transform("[1, 0, 0, 1]"), &[]);
    assert!(error.contains("the quaternion has length 1.41"), "{error}");
    assert!(refuse(&transform("[nan, 0, 0, 1]"), &[]).contains("length NaN"));
    assert!(refuse(&transform("[0, 0, 1]"), &[]).contains("frames.base_from_camera = {"));
    let config = accept(&transform("[0, 0, 0, 1]"), &[]);
    assert_eq!(config.frames.base_from_camera.translation.vector.as_slice(), &[1.0, 2.0, 3.0]);
}

#[test]
fn the_default_mounting_turns_optical_axes_into_body_axes() {
    let base_from_camera = GrnetdConfig::default().frames.base_from_camera;
    let forward_in_camera = nalgebra::Vector3::z();
    let right_in_camera = nalgebra::Vector3::x();
    assert!((base_from_camera * forward_in_camera - nalgebra::Vector3::x()).norm() < 1e-15);
    assert!((base_from_camera * right_in_camera + nalgebra::Vector3::y()).norm() < 1e-15);
}

#[test]
fn overrides_go_before_the_file_and_are_named() {
    let config = accept("[source]\npace = 'realtime'\n", &["source.pace=max", "source.loop = true"]);
    assert_eq!((config.source.pace, config.source.looped), (Pace::Max, true));
    assert_eq!(accept("", &["source.pace=0.5", "source.pace=2"]).source.pace, Pace::Factor(2.0));
    // A sequence that looks like a number is still a name.
    assert_eq!(accept("", &["source.sequence=10"]).source.sequence.as_deref(), Some("10"));
    assert_eq!(accept("", &["source.sequence=04"]).source.sequence.as_deref(), Some("04"));

    let error = refuse("", &["source.paec=max"]);
    assert!(
        error.starts_with("override `source.paec=max`: unknown key `source.paec`; did you mean"),
        "{error}"
    );
    let error = refuse("[publish]\ncreation_timeout_ms = 5", &["publish.creation_timeout_ms=2000"]);
    assert!(error.starts_with("override `publish.creation_timeout_ms=2000`: "), "{error}");
    let error = refuse("", &["source.loop=maybe"]);
    assert!(error.contains("override `source.loop=maybe`") && error.contains("true or false"), "{error}");
    for text in ["source.pace", "=max", "a b=1", "source.pace="] {
        let error = Override::parse(text).unwrap_err().to_string();
        assert!(error.contains(text) && error.contains("--set section.key=value"), "{error}");
    }
}

#[test]
fn relative_paths_are_relative_to_the_file_they_stand_in() {
    let text = "[source]\npath = 'frames'\n[model]\ncheckpoint = '/abs/m.safetensors'\nscene = 's'";
    let config = accept(text, &["model.scene=other"]);
    assert_eq!(config.source.path, Path::new("/etc/frames"));
    assert_eq!(config.model.checkpoint, Path::new("/abs/m.safetensors"));
    assert_eq!(config.model.scene.as_deref(), Some(Path::new("other")));
}

#[test]
fn names_that_would_break_service_names_are_refused() {
    assert!(refuse("[camera]\nname = 'a/b'", &[]).contains("`/` cannot be part of it"));
    assert!(refuse("[camera]\nname = ''", &[]).contains("it is empty"));
    assert!(refuse("[camera]\nname = '-a'", &[]).contains("it starts with punctuation"));
    assert!(refuse("[publish]\nroot = 'relative'", &[]).contains("it is relative"));
    assert!(refuse("[publish]\nprefix = 'a_'", &[]).contains("it needs publish.root"));
    assert!(refuse("[publish]\nroot = '/r'\nprefix = 'a/'", &[]).contains("publish.prefix = 'a/'"));
    for key in ["group", "control_group"] {
        let error = refuse(&format!("[publish]\n{key} = 'grnet'"), &[]);
        assert!(error.contains("it needs publish.access = \"group\""), "{error}");
    }
    let error = refuse("[publish]\naccess = 'group'\ngroup = 'a:b'", &[]);
    assert!(error.contains("publish.group = 'a:b'"), "{error}");
    let long = format!("[publish]\nroot = '/{}'", "r".repeat(60));
    assert!(refuse(&long, &[]).contains("socket names below it"));
    assert!(refuse("[log]\nlevel = 'loud'", &[]).contains("`loud` is neither a level"));
    assert_eq!(
        accept("[log]\nlevel = 'info,grnet_capture=debug'", &[]).log.level,
        "info,grnet_capture=debug"
    );
}

proptest! {
    /// Whatever stands in a file, the answer is a configuration or an error.
    #[test]
    fn no_text_is_too_strange(text in "(\\[(source|publish|frames|zoo)\\]\n)?([a-z_.]{1,12} ?= ?[ -~é]{0,12}\n){0,4}") {
        let _ = GrnetdConfig::parse(&text, Path::new("g.toml"), &[]);
        if let Ok(item) = Override::parse(&text) {
            let _ = GrnetdConfig::parse("", Path::new("g.toml"), &[item]);
        }
    }
}

#[test]
fn a_camera_is_asked_for_by_format_size_rate_and_controls() {
    let camera = "[source]\nkind = 'v4l2'\n";
    let text = format!(
        "{camera}format = 'RGB24'\nsize_px = [640, 480]\ncontrols = {{ gain = 3 }}\nstall_ms = 100\n"
    );
    let config = accept(&text, &["source.controls.brightness=7"]).source;
    assert_eq!(config.kind, grnet_config::SourceKind::V4l2);
    assert_eq!(config.v4l2.format.unwrap().to_string(), "RGB24");
    assert_eq!(config.v4l2.size_px, Some((640, 480)));
    assert_eq!(config.v4l2.controls, [("brightness".to_owned(), 7)].into(), "an override replaces the key");
    for (wrong, key) in [
        ("format = 'H264'", "source.format = 'H264'"),
        ("size_px = [0, 480]", "source.size_px = [0, 480]"),
        ("size_px = [480]", "source.size_px = [480]"),
        ("controls = { gain = 'high' }", "source.controls = {"),
        ("buffers = 1", "source.buffers = 1: out of range"),
        ("stall_ms = 99", "source.stall_ms = 99: out of range"),
        ("loop = true", "source.loop = true: it is for a recording"),
        ("pace = 'max'", "source.pace = 'max': it is for a recording"),
        ("frame_limit = 3", "source.frame_limit = 3: it is for a recording"),
    ] {
        let error = refuse(&format!("{camera}{wrong}"), &[]);
        assert!(error.contains("/etc/g.toml:3:") && error.contains(key), "{wrong}: {error}");
    }
}
