//! The messages: plain data of fixed size and layout.

mod control;
mod id;
mod kinds;
pub mod layout;
mod pose;
mod status;
mod text;

pub use control::{ControlReply, ControlRequest};
pub use id::{BootId, ContentHash};
pub use kinds::{
    Access, CaptureClock, Command, Health, Outcome, Provenance, Reason, Recording, SourceState, Status,
};
pub use pose::{PoseSample, PoseWithCovariance, SCHEMA_VERSION, StageLatency, UNKNOWN_U64};
pub use status::{DaemonStatus, LatencyPercentiles, MAX_SCENES, SceneInfo, StagePercentiles};
pub use text::FixedText;
