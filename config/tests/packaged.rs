//! The configuration that the Debian package installs: it can be read, and every line of it has a reason.

use std::path::Path;

use grnet_config::{Access, GrnetdConfig, IntrinsicsPolicy, SourceKind};

const PACKAGED: &str = include_str!("../packaged.toml");
const PLACE: &str = "/etc/grnet/grnetd.toml";

fn parse(text: &str) -> GrnetdConfig {
    GrnetdConfig::parse(text, Path::new(PLACE), &[]).unwrap()
}

#[test]
fn it_says_what_the_package_promises() {
    let config = parse(PACKAGED);
    assert_eq!(config.source.kind, SourceKind::V4l2);
    assert_eq!(config.model.checkpoint, Path::new("/usr/share/grnet/trunk.safetensors"));
    assert_eq!((config.model.scene, config.model.intrinsics), (None, IntrinsicsPolicy::Convert));
    assert_eq!(config.publish.access, Access::Group);
    assert_eq!(config.publish.control_group.as_deref(), Some("grnet-admin"));
}

#[test]
fn every_line_but_the_camera_differs_from_the_default() {
    for line in PACKAGED.lines().filter(|line| line.contains(" = ") && !line.starts_with('#')) {
        let without = GrnetdConfig::parse(&PACKAGED.replace(line, ""), Path::new(PLACE), &[]);
        let changes = without.ok() != Some(parse(PACKAGED));
        // The first thing that a user will look for.
        assert!(changes || line.starts_with("device = "), "{line} is the default: leave it out");
    }
}

#[test]
fn what_it_offers_in_comments_is_known() {
    let offered: Vec<_> =
        PACKAGED.lines().filter(|line| line.starts_with('#') && !line.starts_with("# ")).collect();
    assert!(!offered.is_empty());
    let all = PACKAGED.replace("\n#scene", "\nscene");
    assert!(parse(&all).model.scene.is_some() && offered.len() == 1, "{offered:?}");
}
