//! Hashes of what windows are made from.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

use grnet_frame::{Camera, Distortion};
use grnet_geometry::Pose;
use grnet_pipeline::preprocess::InputSpec;
use serde::Serialize;
use sha2::{Digest, Sha256};

use super::DataError;

/// Bytes at the end of a file that are hashed beside its length.
///
/// A PNG ends with checksums of all of its pixels, and the last bits of a JPEG move with every change before them; so
/// whole data sets need not be read to notice another image.
const TAIL_BYTES: u64 = 4096;

/// SHA-256 over labelled parts, so that no two lists of parts give the same stream of bytes.
#[derive(Debug, Default)]
pub(crate) struct Fingerprint(Sha256);

impl Fingerprint {
    pub fn bytes(&mut self, bytes: &[u8]) {
        self.0.update((bytes.len() as u64).to_le_bytes());
        self.0.update(bytes);
    }

    pub fn text(&mut self, text: &str) {
        self.bytes(text.as_bytes());
    }

    pub fn numbers(&mut self, numbers: &[f64]) {
        let bytes: Vec<u8> = numbers.iter().flat_map(|x| x.to_bits().to_le_bytes()).collect();
        self.bytes(&bytes);
    }

    /// Options that serialise without fail: plain structs of numbers and names.
    pub fn options(&mut self, options: &impl Serialize) {
        self.text(&serde_json::to_string(options).unwrap_or_default());
    }

    pub fn pose(&mut self, pose: &Pose) {
        let (t, q) = (&pose.translation.vector, pose.rotation.coords);
        self.numbers(&[t.x, t.y, t.z, q.x, q.y, q.z, q.w]);
    }

    pub fn camera(&mut self, camera: Option<&Camera>) {
        let Some(camera) = camera else { return self.text("no camera") };
        let ((width, height), (fx, fy), (cx, cy)) = (camera.size_px(), camera.focal_px(), camera.centre_px());
        self.numbers(&[width.into(), height.into(), fx, fy, cx, cy]);
        match camera.distortion() {
            Distortion::None => self.text("no distortion"),
            Distortion::PlumbBob(k) => self.numbers(&k),
            Distortion::Equidistant(k) => self.numbers(&k),
        }
    }

    pub fn input(&mut self, input: &InputSpec) {
        self.numbers(&[input.size_px.0.into(), input.size_px.1.into()]);
        self.options(&input.preprocessing);
        self.camera(input.trained_camera.as_ref());
    }

    /// Length and end of a file.
    pub fn file(&mut self, path: &Path) -> Result<(), DataError> {
        let read = || -> std::io::Result<(u64, Vec<u8>)> {
            let mut file = File::open(path)?;
            let length = file.metadata()?.len();
            file.seek(SeekFrom::Start(length.saturating_sub(TAIL_BYTES)))?;
            let mut tail = Vec::new();
            file.take(TAIL_BYTES).read_to_end(&mut tail)?;
            Ok((length, tail))
        };
        let (length, tail) = read().map_err(|source| DataError::Read { path: path.into(), source })?;
        self.0.update(length.to_le_bytes());
        self.bytes(&tail);
        Ok(())
    }

    pub fn finish(self) -> String {
        self.0.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
    }
}
