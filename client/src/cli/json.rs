//! Samples and states as JSON; what is not known is `null`.

use grnet_client::{DaemonStatus, Sample};
use grnet_geometry::{Covariance6, Pose, nalgebra::Vector3, quaternion};
use serde_json::{Value, json};

use super::reference::Deviation;

/// One sample; `lost_samples` counts what this client never saw.
pub fn sample(sample: &Sample, lost_samples: u64) -> Value {
    let raw = sample.raw();
    let latency = sample.latency();
    json!({
        "schema_version": raw.schema_version,
        "boot_id": raw.boot_id.to_string(),
        "sample": raw.sample,
        "sequence": sample.sequence(),
        "camera": raw.camera.to_string(),
        "status": raw.status.to_string(),
        "reason": raw.reason.to_string(),
        "scene": sample.scene(),
        "model_hash": raw.model_hash.to_string(),
        "capture_time_ns": sample.capture_time().map(|time| time.ns),
        "capture_clock": raw.capture_clock.to_string(),
        "capture_epoch_ns": sample.capture_epoch_ns(),
        "publish_time_ns": raw.publish_time_ns,
        "realtime_offset_ns": raw.realtime_offset_ns,
        "reset_epoch": raw.reset_epoch,
        "dropped_frames": raw.dropped_frames,
        "lost_samples": lost_samples,
        "map_from_base": pose(sample.map_from_base(), sample.map_covariance()),
        "odom_from_base": pose(sample.odom_from_base(), sample.odom_covariance()),
        "previous_from_current": pose(sample.previous_from_current(), sample.motion_covariance()),
        "network_map_from_base": pose(sample.network_map_from_base(), None),
        "linear_velocity_in_base_mps": vector(sample.linear_velocity_in_base_mps()),
        "angular_velocity_in_base_radps": vector(sample.angular_velocity_in_base_radps()),
        "innovation_ratio": sample.innovation_ratio(),
        "landmark_inliers": raw.landmark_inliers,
        "latency_us": {
            "wait": microseconds(latency.wait_us),
            "preprocess": microseconds(latency.preprocess_us),
            "infer": microseconds(latency.infer_us),
            "fuse": microseconds(latency.fuse_us),
            "publish": microseconds(latency.publish_us),
            "total": microseconds(latency.total_us),
        },
    })
}

/// Ground truth and the distance to it.
pub fn deviation(deviation: Option<&Deviation>) -> Value {
    let Some(deviation) = deviation else { return Value::Null };
    let (error_m, error_deg) = deviation.error.unzip();
    json!({ "map_from_base": pose(Some(deviation.map_from_base), None), "error_m": error_m, "error_deg": error_deg })
}

/// The daemon's state.
pub fn status(status: &DaemonStatus) -> Value {
    let latency: serde_json::Map<String, Value> = status
        .latency
        .stages()
        .into_iter()
        .map(|(name, stage)| {
            let percentiles = json!({
                "p50": microseconds(stage.p50_us),
                "p90": microseconds(stage.p90_us),
                "p99": microseconds(stage.p99_us),
                "max": microseconds(stage.max_us),
            });
            (name.to_owned(), percentiles)
        })
        .collect();
    let scenes: Vec<_> = status
        .loaded_scenes()
        .iter()
        .map(|scene| json!({ "name": scene.name.to_string(), "hash": scene.hash.to_string() }))
        .collect();
    json!({
        "schema_version": status.schema_version,
        "version": status.version.to_string(),
        "boot_id": status.boot_id.to_string(),
        "pid": status.pid,
        "camera": status.camera.to_string(),
        "health": status.health.to_string(),
        "access": status.access.to_string(),
        "uptime_s": status.uptime_ns as f64 / 1e9,
        "publish_time_ns": status.publish_time_ns,
        "realtime_offset_ns": status.realtime_offset_ns,
        "source": status.source.to_string(),
        "source_state": status.source_state.to_string(),
        "model": status.model.to_string(),
        "model_hash": status.model_hash.to_string(),
        "provenance": status.provenance.to_string(),
        "scenes": scenes,
        "active_scene": status.scene_in_use().map(|scene| scene.name.to_string()),
        "recording": status.recording.to_string(),
        "recording_path": Some(status.recording_path.to_string()).filter(|path| !path.is_empty()),
        "subscribers": status.subscribers,
        "captured_frames": status.captured_frames,
        "processed_frames": status.processed_frames,
        "published_samples": status.published_samples,
        "dropped_frames": status.dropped_frames,
        "bad_frames": status.bad_frames,
        "refused_frames": status.refused_frames,
        "capture_rate_hz": status.capture_rate_hz,
        "publish_rate_hz": status.publish_rate_hz,
        "reset_epoch": status.reset_epoch,
        "latency_us": latency,
        "error_count": status.error_count,
        "last_error": (status.error_count > 0).then(|| json!({
            "message": status.last_error.to_string(),
            "time_ns": status.last_error_time_ns,
        })),
    })
}

fn pose(pose: Option<Pose>, covariance: Option<Covariance6>) -> Value {
    let Some(pose) = pose else { return Value::Null };
    let rows = covariance.map(|covariance| {
        covariance.matrix().row_iter().map(|row| row.iter().copied().collect::<Vec<_>>()).collect::<Vec<_>>()
    });
    json!({
        "translation_m": pose.translation.vector.as_slice(),
        "quaternion_xyzw": quaternion::xyzw(&pose.rotation),
        "covariance": rows,
    })
}

fn vector(vector: Option<Vector3<f64>>) -> Value {
    vector.map_or(Value::Null, |vector| json!(vector.as_slice()))
}

/// Tenths of a microsecond; NaN becomes `null`.
fn microseconds(us: f32) -> Value {
    json!((f64::from(us) * 10.0).round() / 10.0)
}
