//! The commented example is the documentation: it has every key, with the default.

use std::path::Path;

use grnet_config::{GrnetdConfig, KEYS};

const EXAMPLE: &str = include_str!("../grnetd.toml");

/// The example with the keys that have no default switched on.
fn with_optional_keys() -> String {
    EXAMPLE
        .lines()
        .map(|line| match line.strip_prefix('#') {
            Some(key) if key.starts_with(|c: char| c.is_ascii_lowercase()) => format!("{key}\n"),
            _ => format!("{line}\n"),
        })
        .collect()
}

/// Paths of the keys that a text sets, in order, with comments above them.
fn keys(text: &str) -> Vec<(String, bool)> {
    let mut section = String::new();
    let mut found = Vec::new();
    let mut commented = false;
    for line in text.lines() {
        if let Some(name) = line.strip_prefix('[') {
            section = name.trim_end_matches(']').to_owned();
            commented = false;
        } else if line.starts_with('#') {
            commented = true;
        } else if line.is_empty() {
            commented = false;
        } else if let Some((key, _)) = line.split_once(" = ") {
            found.push((format!("{section}.{key}"), commented));
        }
    }
    found
}

#[test]
fn the_example_and_the_empty_file_and_the_default_are_the_same() {
    let parse = |text| GrnetdConfig::parse(text, Path::new("grnetd.toml"), &[]).unwrap();
    // An empty [source.intrinsics] stands in the example to hold its commented keys.
    assert_eq!(parse(EXAMPLE), GrnetdConfig::default());
    assert_eq!(parse(""), GrnetdConfig::default());
}

#[test]
fn the_example_has_every_key_in_order_and_each_is_explained() {
    let text = with_optional_keys();
    let found = keys(&text);
    let paths: Vec<&str> = found.iter().map(|(path, _)| path.as_str()).collect();
    let expected: Vec<&str> = KEYS.iter().map(|key| key.path).collect();
    assert_eq!(paths, expected);
    let shares_a_comment = [
        "height_px",
        "fy_px",
        "cy_px",
        "prefix",
        "frame_limit",
        "size_px",
        "worker_priority",
        "publish_priority",
    ]
    .map(|name| format!(".{name}"))
    .map(String::from);
    for (path, commented) in found {
        let shared = shares_a_comment.iter().any(|name| path.ends_with(name));
        assert!(commented || shared, "{path} has no comment");
    }
    let without_optional = keys(EXAMPLE);
    for key in KEYS {
        let present = without_optional.iter().any(|(path, _)| path == key.path);
        assert_eq!(present, !key.optional, "{}", key.path);
    }
}

#[test]
fn the_example_with_every_key_is_valid() {
    // Groups are for access by group alone.
    let text = with_optional_keys().replace("\naccess = \"user\"\n", "\naccess = \"group\"\n");
    let config = GrnetdConfig::parse(&text, Path::new("grnetd.toml"), &[]).unwrap();
    assert!(config.source.camera.is_some() && config.model.scene.is_some());
    assert_eq!(config.publish.prefix.as_deref(), Some("grnet_"));
    assert_eq!(config.publish.control_group.as_deref(), Some("grnet-admin"));
}

#[test]
fn the_demo_is_valid() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("demo.toml");
    let config = GrnetdConfig::load(&path, &[]).unwrap();
    assert_eq!(config.camera_name, "demo");
    assert!(config.source.path.starts_with(env!("CARGO_MANIFEST_DIR")), "{:?}", config.source.path);
}
