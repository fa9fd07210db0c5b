//! Decodes the frames of a schedule.

use std::error::Error;
use std::sync::Arc;

use grnet_frame::{Camera, CaptureTime, Frame, Pixels, SourceError};

use super::schedule::Schedule;
use crate::decode::decode_file;

/// Reads frames and holds them to one size.
#[derive(Debug)]
pub(crate) struct Reader {
    pub schedule: Schedule,
    /// That of the intrinsics or of the first good frame.
    pub size_px: Option<(u32, u32)>,
}

/// A decoded frame that has no time yet.
#[derive(Debug)]
pub(crate) struct Undated {
    pixels: Arc<Pixels>,
    sequence: u64,
    camera: Option<Camera>,
}

impl Undated {
    pub fn at(self, capture_time: CaptureTime) -> Frame {
        Frame { pixels: self.pixels, capture_time, sequence: self.sequence, camera: self.camera }
    }
}

impl Reader {
    /// Decodes the frame of a step that the schedule has.
    pub fn read(&mut self, step: u64) -> Result<Undated, SourceError> {
        let Some(planned) = self.schedule.step(step) else {
            return Err(self.bad(step, "the recording has no such frame".into()));
        };
        let (path, sequence) = (&planned.frame.path, planned.sequence);
        let camera = planned.frame.camera.or(self.schedule.camera);
        let pixels = match decode_file(path) {
            Ok(pixels) => pixels,
            Err(error) => {
                let cause = error.source().map(|cause| format!(": {cause}")).unwrap_or_default();
                let named = error.to_string();
                let place = if named.contains(&*path.to_string_lossy()) {
                    String::new()
                } else {
                    format!("{}: ", path.display())
                };
                return Err(self.bad(sequence, format!("{place}{named}{cause}")));
            }
        };
        let found = (pixels.width_px(), pixels.height_px());
        let expected = *self.size_px.get_or_insert(found);
        if found != expected {
            let reason = format!(
                "{}: found {}x{} pixels, expected {}x{} as in the rest of the recording",
                path.display(),
                found.0,
                found.1,
                expected.0,
                expected.1
            );
            return Err(self.bad(sequence, reason));
        }
        Ok(Undated { pixels: Arc::new(pixels), sequence, camera })
    }

    fn bad(&self, sequence: u64, reason: String) -> SourceError {
        SourceError::BadFrame { source_name: self.schedule.name.clone(), sequence, reason }
    }
}
