//! The daemon's own state, published twice a second whether frames arrive or not.

use iceoryx2::prelude::ZeroCopySend;

use super::{
    Access, BootId, ContentHash, FixedText, Health, Provenance, Recording, SCHEMA_VERSION, SourceState,
    layout::wire_struct,
};
use crate::CameraName;

/// How many loaded scenes a status can name.
pub const MAX_SCENES: usize = 8;

wire_struct! {
    /// Percentiles of one stage's latency over the last seconds, in microseconds; NaN before the
    /// first frame.
    StagePercentiles, type_name = "grnet.StagePercentiles.v1", size = 16, align = 4 {
        /// Median.
        0 => p50_us: f32,
        /// 90th percentile.
        4 => p90_us: f32,
        /// 99th percentile.
        8 => p99_us: f32,
        /// The slowest.
        12 => max_us: f32,
    }
}

wire_struct! {
    /// Latency percentiles of every stage; the stages are those of
    /// [`StageLatency`](crate::StageLatency).
    LatencyPercentiles, type_name = "grnet.LatencyPercentiles.v1", size = 96, align = 4 {
        /// From the capture of the frame until the worker took it.
        0 => wait: StagePercentiles,
        /// Decoding, resizing, normalising.
        16 => preprocess: StagePercentiles,
        /// The network.
        32 => infer: StagePercentiles,
        /// Fusion of relative and global pose.
        48 => fuse: StagePercentiles,
        /// From the end of fusion until the sample was handed to the transport.
        64 => publish: StagePercentiles,
        /// From capture to publication.
        80 => total: StagePercentiles,
    }
}

wire_struct! {
    /// A scene that is loaded.
    SceneInfo, type_name = "grnet.SceneInfo.v1", size = 96, align = 1 {
        /// Its name; empty where no scene is.
        0 => name: FixedText<64>,
        /// SHA-256 of its weights.
        64 => hash: ContentHash,
    }
}

wire_struct! {
    /// What the daemon says about itself, on `grnet/<camera>/status`.
    DaemonStatus, type_name = "grnet.DaemonStatus.v1", size = 2304, align = 8 {
        /// Version of the message: [`SCHEMA_VERSION`].
        0 => schema_version: u32,
        /// Health in one word.
        4 => health: Health,
        /// What the frame source does.
        8 => source_state: SourceState,
        /// Are the weights trained?
        12 => provenance: Provenance,
        /// Who may subscribe.
        16 => access: Access,
        /// Is a recording being written?
        20 => recording: Recording,
        /// Process id of the daemon.
        24 => pid: u32,
        /// Pose subscribers that are attached now.
        28 => subscribers: u32,
        /// This run of the daemon.
        32 => boot_id: BootId,
        /// SHA-256 of the network's weights.
        48 => model_hash: ContentHash,
        /// Name of the model: its file name without folder.
        80 => model: FixedText<96>,
        /// Version of the daemon's package.
        176 => version: FixedText<32>,
        /// Name of the camera.
        208 => camera: FixedText<32>,
        /// The frame source as configured, e.g. a device or a folder.
        240 => source: FixedText<256>,
        /// The recording being written; empty when none is.
        496 => recording_path: FixedText<256>,
        /// Counts the status messages of this boot, from 1.
        752 => sample: u64,
        /// When this status was published, ns on `CLOCK_MONOTONIC`.
        760 => publish_time_ns: u64,
        /// `CLOCK_REALTIME - CLOCK_MONOTONIC`, ns.
        768 => realtime_offset_ns: i64,
        /// Time since the daemon started, ns.
        776 => uptime_ns: u64,
        /// Frames that the source delivered.
        784 => captured_frames: u64,
        /// Frames that became a pose sample.
        792 => processed_frames: u64,
        /// Pose samples published, those without a frame included.
        800 => published_samples: u64,
        /// Good frames given up because a newer one came first.
        808 => dropped_frames: u64,
        /// Frames that were corrupt, truncated or of the wrong size.
        816 => bad_frames: u64,
        /// Frames refused because their time repeated or went back.
        824 => refused_frames: u64,
        /// Frames per second from the source over the last seconds; NaN before the first.
        832 => capture_rate_hz: f64,
        /// Samples with a frame published per second over the last seconds; NaN before the first.
        840 => publish_rate_hz: f64,
        /// Counts the jumps of the odometry frame.
        848 => reset_epoch: u32,
        /// Index in `scenes` of the scene in use; `u32::MAX` without one.
        852 => active_scene: u32,
        /// Latency of every stage over the last seconds.
        856 => latency: LatencyPercentiles,
        /// The loaded scenes; an empty name ends the list.
        952 => scenes: [SceneInfo; 8],
        /// Errors since the daemon started; 0 means that `last_error` is empty.
        1720 => error_count: u64,
        /// When the last error happened, ns on `CLOCK_MONOTONIC`; meaningless while `error_count` is 0.
        1728 => last_error_time_ns: u64,
        /// The last error in words, with the remedy.
        1736 => last_error: FixedText<512>,
        /// Zero; room for later fields of this version.
        2248 => reserved: [u64; 7],
    }
}

impl StagePercentiles {
    /// Nothing was measured.
    pub const UNKNOWN: Self = Self { p50_us: f32::NAN, p90_us: f32::NAN, p99_us: f32::NAN, max_us: f32::NAN };
}

impl LatencyPercentiles {
    /// Nothing was measured.
    pub const UNKNOWN: Self = Self {
        wait: StagePercentiles::UNKNOWN,
        preprocess: StagePercentiles::UNKNOWN,
        infer: StagePercentiles::UNKNOWN,
        fuse: StagePercentiles::UNKNOWN,
        publish: StagePercentiles::UNKNOWN,
        total: StagePercentiles::UNKNOWN,
    };

    /// The stages by name, in the order a frame passes them, the total last.
    pub fn stages(&self) -> [(&'static str, StagePercentiles); 6] {
        [
            ("wait", self.wait),
            ("preprocess", self.preprocess),
            ("infer", self.infer),
            ("fuse", self.fuse),
            ("publish", self.publish),
            ("total", self.total),
        ]
    }
}

impl SceneInfo {
    /// No scene.
    pub const NONE: Self = Self { name: FixedText::EMPTY, hash: ContentHash::NONE };
}

impl DaemonStatus {
    /// A status in which nothing is known but who speaks.
    pub fn unknown(boot_id: BootId, camera: &CameraName, access: Access) -> Self {
        Self {
            schema_version: SCHEMA_VERSION,
            health: Health::UNKNOWN,
            source_state: SourceState::UNKNOWN,
            provenance: Provenance::UNKNOWN,
            access,
            recording: Recording::UNKNOWN,
            pid: std::process::id(),
            subscribers: 0,
            boot_id,
            model_hash: ContentHash::NONE,
            model: FixedText::EMPTY,
            version: FixedText::new(crate::PACKAGE_VERSION),
            camera: FixedText::new(camera.as_str()),
            source: FixedText::EMPTY,
            recording_path: FixedText::EMPTY,
            sample: 0,
            publish_time_ns: super::UNKNOWN_U64,
            realtime_offset_ns: 0,
            uptime_ns: 0,
            captured_frames: 0,
            processed_frames: 0,
            published_samples: 0,
            dropped_frames: 0,
            bad_frames: 0,
            refused_frames: 0,
            capture_rate_hz: f64::NAN,
            publish_rate_hz: f64::NAN,
            reset_epoch: 0,
            active_scene: u32::MAX,
            latency: LatencyPercentiles::UNKNOWN,
            scenes: [SceneInfo::NONE; MAX_SCENES],
            error_count: 0,
            last_error_time_ns: super::UNKNOWN_U64,
            last_error: FixedText::EMPTY,
            reserved: [0; 7],
        }
    }

    /// The loaded scenes.
    pub fn loaded_scenes(&self) -> &[SceneInfo] {
        let count = self.scenes.iter().position(|scene| scene.name.is_empty()).unwrap_or(MAX_SCENES);
        &self.scenes[..count]
    }

    /// The scene in use.
    pub fn scene_in_use(&self) -> Option<&SceneInfo> {
        self.loaded_scenes().get(usize::try_from(self.active_scene).ok()?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn foreign_scene_indices_are_harmless() {
        let mut status = DaemonStatus::unknown(BootId::NONE, &"front".parse().unwrap(), Access::USER);
        assert!(status.loaded_scenes().is_empty());
        assert_eq!(status.scene_in_use(), None);
        status.scenes[0].name = FixedText::new("kitchen");
        status.active_scene = 7;
        assert_eq!(status.scene_in_use(), None);
        status.active_scene = 0;
        assert!(status.scene_in_use().is_some_and(|scene| scene.name == "kitchen"));
    }
}
