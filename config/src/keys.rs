//! Every key there is, what it may be, and the nearest one to a misspelling.

/// A key of the configuration.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Key {
    /// `section.key`.
    pub path: &'static str,
    /// What its value may be, with the unit.
    pub allowed: &'static str,
    /// Whether it may be absent, so that it has no default.
    pub optional: bool,
}

const fn key(path: &'static str, allowed: &'static str) -> Key {
    Key { path, allowed, optional: false }
}

const fn optional(path: &'static str, allowed: &'static str) -> Key {
    Key { path, allowed, optional: true }
}

const TRANSFORM: &str =
    "{ translation_m = [x, y, z], quaternion_xyzw = [x, y, z, w] } with a quaternion of length 1";

/// Every key, in the order of the commented example.
pub const KEYS: &[Key] = &[
    key("camera.name", "1 to 31 of a-z A-Z 0-9 _ - . starting with a letter, digit or _"),
    key("source.kind", "\"folder\", \"video\" or \"v4l2\""),
    key("source.path", "a folder, or a video file"),
    key("source.layout", "\"auto\", \"7scenes\", \"kitti\" or \"images\""),
    optional("source.sequence", "the name of one sequence of the dataset"),
    optional("source.dataset_camera", "the name of one camera of the dataset, such as \"image_2\""),
    key("source.pace", "\"realtime\", \"max\", or a factor greater than 0 and at most 1000"),
    key("source.loop", "true or false"),
    key("source.first_frame", "an integer from 0 (index in the recording)"),
    optional("source.frame_limit", "an integer from 1 (frames)"),
    key("source.device", "a V4L2 device such as \"/dev/video0\""),
    optional("source.format", "\"YUYV\", \"NV12\", \"RGB24\", \"GREY\" or \"MJPG\""),
    optional("source.size_px", "[width, height], integers from 1 to 16384 (pixels)"),
    optional("source.controls", "{ name = integer, ... } with names that `grnetd devices` lists"),
    key("source.accept_substitutes", "true or false"),
    key("source.buffers", "an integer from 2 to 32"),
    key("source.stall_ms", "an integer from 100 to 60000 (milliseconds)"),
    optional("source.rate_hz", "a number greater than 0 and at most 1000 (frames per second)"),
    key("source.time_offset_ms", "a number from -1000 to 1000 (milliseconds)"),
    key("source.silence_ms", "an integer from 50 to 60000 (milliseconds)"),
    optional(
        "source.calibration",
        "a YAML file of ROS camera_info, Kalibr or OpenCV, without [source.intrinsics]",
    ),
    optional("source.calibration_camera", "a camera of a Kalibr chain, such as \"cam0\""),
    optional("source.intrinsics.width_px", "an integer from 1 to 65535 (pixels)"),
    optional("source.intrinsics.height_px", "an integer from 1 to 65535 (pixels)"),
    optional("source.intrinsics.fx_px", "a number greater than 0 (pixels)"),
    optional("source.intrinsics.fy_px", "a number greater than 0 (pixels)"),
    optional("source.intrinsics.cx_px", "a number (pixels)"),
    optional("source.intrinsics.cy_px", "a number (pixels)"),
    optional("source.intrinsics.distortion", "\"none\", \"plumb_bob\" or \"equidistant\""),
    optional(
        "source.intrinsics.coefficients",
        "[] for none, [k1, k2, p1, p2, k3] for plumb_bob, [k1, k2, k3, k4] for equidistant",
    ),
    key("model.checkpoint", "a .safetensors file"),
    optional("model.scene", "a .safetensors file of kind \"scene\""),
    key("model.intrinsics", "\"refuse\" or \"convert\""),
    key("model.intrinsics_tolerance", "a number from 0 to 1 (share of the input's width)"),
    key("model.least_coverage", "a number from 0 to 1 (share of the input)"),
    key("model.undistort", "true or false"),
    key(
        "frames.base_from_camera",
        "\"optical_to_body\", \"identity\", or { translation_m = [x, y, z], quaternion_xyzw = [x, y, z, w] } with a quaternion of length 1",
    ),
    optional("frames.map_from_world", TRANSFORM),
    key("tracking.longest_gap_ms", "an integer from 10 to 60000 (milliseconds)"),
    key("tracking.refused_before_restart", "an integer from 0 to 100000 (frames), 0 for never"),
    key("tracking.initializing_frames", "an integer from 1 to 1000 (frames)"),
    key("tracking.gate", "true or false"),
    key("tracking.rejections_allowed", "an integer from 0 to 100000 (frames)"),
    key("tracking.after_rejections", "\"reinitialise\" or \"lost\""),
    key("tracking.agreements_to_recover", "an integer from 1 to 1000 (frames)"),
    key("tracking.map_smoothing_ms", "an integer from 0 to 60000 (milliseconds), 0 for no smoothing"),
    key("publish.access", "\"user\", \"group\" or \"everyone\""),
    optional("publish.group", "the name or number of a group, together with publish.access = \"group\""),
    optional(
        "publish.control_group",
        "the name or number of a group, together with publish.access = \"group\"",
    ),
    optional("publish.root", "an absolute path; with the prefix at most 60 bytes"),
    optional("publish.prefix", "1 to 24 of a-z A-Z 0-9 _, together with publish.root"),
    key("publish.creation_timeout_ms", "an integer from 1 to 1000 (milliseconds)"),
    key("publish.status_rate_hz", "a number from 2 to 50 (per second)"),
    key("publish.wait_for_subscribers", "an integer from 0 to 16"),
    key("record.folder", "a folder"),
    key("record.format", "\"png\" or \"jpeg\""),
    key("record.jpeg_quality", "an integer from 1 to 100"),
    key("record.queue_frames", "an integer from 1 to 1000 (frames)"),
    key("record.least_free_mib", "an integer from 0 to 1000000 (MiB)"),
    optional("realtime.capture_priority", "an integer from 1 to 99"),
    optional("realtime.worker_priority", "an integer from 1 to 99"),
    optional("realtime.publish_priority", "an integer from 1 to 99"),
    optional("realtime.nice", "an integer from -20 to 19"),
    optional("realtime.cpus", "[numbers of CPUs], from 0 to 1023"),
    optional("realtime.worker_cpus", "[numbers of CPUs], from 0 to 1023"),
    key("realtime.lock_memory", "true or false"),
    key("realtime.required", "true or false"),
    key(
        "log.level",
        "\"error\", \"warn\", \"info\", \"debug\", \"trace\", or directives such as \"info,grnet_capture=debug\"",
    ),
    key("log.format", "\"auto\", \"human\", \"journald\" or \"json\""),
];

/// The key with this path.
pub(crate) fn find(path: &str) -> Option<&'static Key> {
    KEYS.iter().find(|key| key.path == path)
}

/// Whether some key lies inside the section `path`.
pub(crate) fn is_section(path: &str) -> bool {
    KEYS.iter().any(|key| key.path.strip_prefix(path).is_some_and(|rest| rest.starts_with('.')))
}

/// What to say about an unknown key or section: the nearest known ones, with what they may be.
pub(crate) fn hint(unknown: &str) -> String {
    let (section, name) = unknown.rsplit_once('.').unwrap_or(("", unknown));
    if let Some(near) = nearest(section, name) {
        return format!("did you mean `{}` ({})?", near.path, near.allowed);
    }
    if is_section(section) {
        return format!("the keys of [{section}] are {}", list(keys_of(section)));
    }
    if let Some(near) = nearest_section(unknown) {
        return format!("did you mean the section `[{near}]`?");
    }
    format!("the sections are {}", list(sections()))
}

/// The key that `name` most likely means: the same name with its unit, in another section, or misspelt.
fn nearest(section: &str, name: &str) -> Option<&'static Key> {
    let in_section = |key: &&Key| split(key).0 == section;
    let same_stem = |key: &&Key| stem(split(key).1) == stem(name);
    let misspelt = |key: &Key| (split(key).0 == section).then(|| similarity(split(key).1, name));
    KEYS.iter()
        .filter(in_section)
        .find(same_stem)
        .or_else(|| KEYS.iter().find(|key| split(key).1 == name))
        .or_else(|| best(KEYS.iter(), misspelt))
        .or_else(|| KEYS.iter().find(same_stem))
        .or_else(|| best(KEYS.iter(), |key| Some(similarity(key.path, &format!("{section}.{name}")) - 0.08)))
}

fn nearest_section(name: &str) -> Option<&'static str> {
    let mut best: Option<(f64, &str)> = None;
    for section in sections() {
        let score = similarity(section, name);
        if score >= NEAR && best.is_none_or(|(found, _)| score > found) {
            best = Some((score, section));
        }
    }
    best.map(|(_, section)| section)
}

/// Similarity from which two names count as one misspelt.
const NEAR: f64 = 0.8;

fn best<'a>(keys: impl Iterator<Item = &'a Key>, score: impl Fn(&'a Key) -> Option<f64>) -> Option<&'a Key> {
    keys.filter_map(|key| score(key).map(|score| (score, key)))
        .filter(|(score, _)| *score >= NEAR)
        .max_by(|(a, _), (b, _)| a.total_cmp(b))
        .map(|(_, key)| key)
}

fn similarity(a: &str, b: &str) -> f64 {
    strsim::jaro_winkler(a, b).max(strsim::normalized_damerau_levenshtein(a, b))
}

fn split(key: &Key) -> (&'static str, &'static str) {
    key.path.rsplit_once('.').expect("every key has a section")
}

/// A name without its unit.
fn stem(name: &str) -> &str {
    const UNITS: [&str; 11] = ["_ns", "_us", "_ms", "_s", "_sec", "_px", "_m", "_hz", "_rad", "_deg", "_mib"];
    UNITS.iter().find_map(|unit| name.strip_suffix(unit)).unwrap_or(name)
}

fn sections() -> impl Iterator<Item = &'static str> {
    let mut last = "";
    KEYS.iter().filter_map(move |key| {
        let section = split(key).0;
        (section != std::mem::replace(&mut last, section)).then_some(section)
    })
}

fn keys_of(section: &str) -> impl Iterator<Item = &'static str> {
    KEYS.iter().map(split).filter(move |(of, _)| *of == section).map(|(_, name)| name)
}

fn list<'a>(names: impl Iterator<Item = &'a str>) -> String {
    names.map(|name| format!("`{name}`")).collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_forgotten_or_wrong_unit_is_recognised() {
        for wrong in ["publish.creation_timeout", "publish.creation_timeout_s"] {
            let hint = hint(wrong);
            assert!(
                hint.contains("`publish.creation_timeout_ms` (an integer from 1 to 1000 (milli"),
                "{hint}"
            );
        }
        assert!(hint("source.intrinsics.fx").contains("fx_px"));
    }

    #[test]
    fn a_misspelling_is_recognised() {
        assert!(hint("source.layuot").contains("`source.layout`"));
        assert!(hint("modle.checkpoint").contains("`model.checkpoint`"));
        assert!(hint("publsh").contains("`[publish]`"));
    }

    #[test]
    fn a_key_of_another_section_is_recognised() {
        assert!(hint("model.pace").contains("`source.pace`"));
        assert!(hint("checkpoint").contains("`model.checkpoint`"));
    }

    #[test]
    fn a_strange_key_gets_the_list() {
        assert_eq!(hint("log.zzz"), "the keys of [log] are `level`, `format`");
        assert!(hint("zzz").starts_with("the sections are `camera`, `source`, `source.intrinsics`, `model`"));
    }
}
