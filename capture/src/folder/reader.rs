//! Decodes the frames of a schedule.

use std::error::Error;
use std::sync::Arc;

use grnet_frame::SourceError;

use super::schedule::Schedule;
use crate::decode::decode_file;
use crate::play::{Footage, Shot, Undated};

/// Reads frames and holds them to one size.
#[derive(Debug)]
pub(crate) struct Reader {
    pub schedule: Schedule,
    /// That of the intrinsics or of the first good frame.
    pub size_px: Option<(u32, u32)>,
    /// The next step to be read.
    pub step: u64,
}

impl Footage for Reader {
    // Any frame can be read without those before it.
    const MOST_LAG_NS: u64 = u64::MAX;

    fn skip_to(&mut self, elapsed_ns: u64) -> u64 {
        if self.schedule.step(self.step).is_none() {
            return 0;
        }
        let newest = self.schedule.newest_due(self.step, elapsed_ns);
        newest - std::mem::replace(&mut self.step, newest)
    }

    fn next(&mut self) -> Option<Shot> {
        let planned = self.schedule.step(self.step)?;
        let (offset_ns, recorded_ns) = (planned.offset_ns, self.schedule.recorded_ns(&planned));
        let frame = self.read(self.step);
        self.step += 1;
        Some(Shot { offset_ns, recorded_ns, frame })
    }
}

impl Reader {
    /// Decodes the frame of a step that the schedule has.
    fn read(&mut self, step: u64) -> Result<Undated, SourceError> {
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
