//! `grnetd check`: what would run, in words.

use std::io::Write;

use grnet_geometry::{Pose, quaternion};
use grnet_model::Heads;
use grnet_proto::{ContentHash, names, qos};

use crate::failure::Failure;
use crate::realtime::{Realtime, Refusal};
use crate::run::Loaded;
use crate::setup::Parts;

/// Prepares everything as `grnetd run` does, writes what it found to `out`, and starts nothing.
///
/// # Errors
/// What `grnetd run` would end with, and when `out` cannot be written.
pub fn check(loaded: &Loaded, out: &mut impl Write) -> Result<(), Failure> {
    let realtime = Realtime::prepare(&loaded.config.realtime)?;
    let parts = Parts::prepare(&loaded.config)?;
    let text = describe(loaded, &parts, &realtime)?;
    out.write_all(text.as_bytes())
        .map_err(|error| Failure::internal(format!("cannot write to standard output: {error}")))
}

fn describe(
    loaded: &Loaded,
    parts: &Parts,
    (realtime, refusals): &(Realtime, Vec<Refusal>),
) -> Result<String, Failure> {
    let Parts { camera, transport, source, model, pipeline, .. } = parts;
    let info = pipeline.info();
    let source = source.info();
    let mut text = String::new();
    let mut line = |name: &str, value: String| text += &format!("{name:<18}{value}\n");

    line("configuration", loaded.path.display().to_string());
    line("services", [names::pose(camera), names::status(camera), names::control(camera)].join(", "));
    line("access", format!("{}, files under {}", transport.access, transport.root));
    let mib = |bytes: u64| bytes as f64 / f64::from(1 << 20);
    let (needed, free) = (qos::shared_memory_needed_bytes(), transport.root.free_space(transport.access)?);
    let place = transport.root.file_system(transport.access);
    line(
        "shared memory",
        format!("at most {:.1} MiB needed, {:.0} MiB free in {}", mib(needed), mib(free), place.display()),
    );

    line("model", format!("{} (SHA-256 {})", model.name, ContentHash(model.model_hash)));
    line("", if model.trained { "trained".into() } else { "NOT TRAINED: its poses mean nothing".to_owned() });
    let (width, height) = info.input_px;
    line("", format!("input {width}x{height}, live heads: {}", heads(info.heads)));
    let scene = model.scene.as_ref().map_or_else(
        || "none: odometry only".to_owned(),
        |scene| format!("{} (SHA-256 {})", scene.name, ContentHash(scene.hash).short()),
    );
    line("scene", scene);
    line("base_from_camera", transform(&info.base_from_camera));
    line("map_from_world", transform(&info.map_from_world));

    line("source", source.name);
    let rate = source.nominal_rate_hz.map_or("unknown rate".to_owned(), |hz| format!("{hz:.3} frames/s"));
    let length = source.length.map_or("without end".to_owned(), |length| format!("{length} frames"));
    line("", format!("{:?}, {rate}, {length}", source.kind));
    let intrinsics = loaded.config.source.camera.or(source.camera).map_or("not known".to_owned(), |camera| {
        let ((width, height), (fx, fy), (cx, cy)) = (camera.size_px(), camera.focal_px(), camera.centre_px());
        format!("{width}x{height}, f ({fx}, {fy}) px, c ({cx}, {cy}) px, {:?}", camera.distortion())
    });
    line("intrinsics", intrinsics);
    let settings = realtime.describe();
    line("real-time", if settings.is_empty() { "nothing asked for".into() } else { settings });
    for refusal in refusals {
        line("", format!("REFUSED: {refusal}"));
    }
    if let Some(advice) = realtime.advice() {
        line("note", advice);
    }
    for note in parts.source_notes.iter().chain(&info.notes) {
        line("note", note.clone());
    }
    line("result", "this configuration can run".into());
    Ok(text)
}

fn transform(pose: &Pose) -> String {
    let t = &pose.translation.vector;
    let [x, y, z, w] = quaternion::xyzw(&pose.rotation);
    format!("translation [{}, {}, {}] m, quaternion xyzw [{x}, {y}, {z}, {w}]", t.x, t.y, t.z)
}

fn heads(heads: Heads) -> String {
    let all = [("relative", heads.relative), ("global", heads.global), ("fused", heads.fused)];
    let live = all.iter().filter(|(_, head)| head.pose).map(|(name, head)| {
        if head.log_variance { format!("{name} with covariance") } else { (*name).to_owned() }
    });
    live.collect::<Vec<_>>().join(", ")
}
