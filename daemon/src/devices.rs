//! `grnetd devices`: which cameras there are, what they offer, and what to write into the configuration.

use std::fmt::Write as _;
use std::io::Write;
use std::path::PathBuf;

use grnet_capture::v4l2::{CameraInfo, list_cameras};
use serde_json::{Value, json};

use crate::failure::Failure;

/// Writes every camera to `out`, as text or as one JSON array.
///
/// # Errors
/// When `out` cannot be written.
pub fn devices(json: bool, out: &mut impl Write) -> Result<(), Failure> {
    let cameras = list_cameras();
    let text = if json {
        format!("{:#}\n", Value::from(cameras.iter().map(as_json).collect::<Vec<_>>()))
    } else if cameras.is_empty() {
        "no V4L2 camera: no /dev/video* captures\n".to_owned()
    } else {
        cameras.iter().map(as_text).collect::<Vec<_>>().join("\n")
    };
    out.write_all(text.as_bytes())
        .map_err(|error| Failure::internal(format!("cannot write to standard output: {error}")))
}

/// The name to configure: one that stays the same when there is one.
fn configured_name(camera: &CameraInfo) -> &PathBuf {
    camera.stable_names.first().unwrap_or(&camera.device)
}

fn as_text(camera: &CameraInfo) -> String {
    let mut text = format!("{}: {} ({})\n", camera.device.display(), camera.card, camera.driver);
    if let Some(problem) = &camera.problem {
        return format!("{}: cannot be asked: {problem}\n", camera.device.display());
    }
    // Writing to a String cannot fail.
    for name in &camera.stable_names {
        let _ = writeln!(text, "  also {}", name.display());
    }
    for mode in &camera.modes {
        let _ = writeln!(text, "  {mode}");
    }
    for control in &camera.controls {
        let fixed = if control.settable { "" } else { ", cannot be set" };
        let (name, least, most, step, default) =
            (&control.name, control.minimum, control.maximum, control.step, control.default);
        let _ = writeln!(
            text,
            "  control {name}: {least} to {most} in steps of {step}, default {default}{fixed}"
        );
    }
    text + &toml(camera)
}

/// Lines to paste; nothing where the camera offers nothing that is understood.
fn toml(camera: &CameraInfo) -> String {
    let Some(mode) = camera.suggested() else { return String::new() };
    let device = Value::from(configured_name(camera).to_string_lossy());
    let (width, height) = mode.size_px;
    let mut text = format!(
        "  configuration:\n    [source]\n    kind = \"v4l2\"\n    device = {device}\n    format = \"{}\"\n    size_px = [{width}, {height}]\n",
        mode.format
    );
    if let Some(rate_hz) = mode.rates_hz.iter().copied().reduce(f64::max) {
        let _ = writeln!(text, "    rate_hz = {rate_hz}");
    }
    text
}

fn as_json(camera: &CameraInfo) -> Value {
    let modes: Vec<Value> = camera
        .modes
        .iter()
        .map(|mode| {
            let ((width, height), largest) = (mode.size_px, mode.largest_px);
            json!({
                "format": mode.format.to_string(),
                "width_px": width, "height_px": height,
                "largest_width_px": largest.map(|size| size.0), "largest_height_px": largest.map(|size| size.1),
                "rates_hz": mode.rates_hz,
            })
        })
        .collect();
    let controls: Vec<Value> = camera
        .controls
        .iter()
        .map(|control| {
            json!({
                "name": control.name, "minimum": control.minimum, "maximum": control.maximum,
                "step": control.step, "default": control.default, "settable": control.settable,
            })
        })
        .collect();
    json!({
        "device": camera.device, "stable_names": camera.stable_names, "card": camera.card, "driver": camera.driver,
        "problem": camera.problem, "modes": modes, "controls": controls,
    })
}
