//! The named numbers of the messages. Zero always means "unknown" or "nothing": memory full of zeros
//! never looks like a valid message.

use iceoryx2::prelude::ZeroCopySend;

use super::layout::wire_enum;

wire_enum! {
    /// How far a pose can be trusted.
    Status {
        /// Nobody said: an all-zero message, never sent by the daemon.
        UNKNOWN = 0 => "UNKNOWN",
        /// The pipeline runs but has no pose yet.
        INITIALIZING = 1 => "INITIALIZING",
        /// The poses are what the network was trained to give.
        TRACKING = 2 => "TRACKING",
        /// Poses are given with a reservation: see the [`Reason`].
        DEGRADED = 3 => "DEGRADED",
        /// The pose is not known; every number of it is NaN.
        LOST = 4 => "LOST",
        /// There are no frames; every number of the pose is NaN.
        SOURCE_LOST = 5 => "SOURCE_LOST",
    }
}

wire_enum! {
    /// Why a sample has the [`Status`] it has.
    Reason {
        /// No reservation.
        NONE = 0 => "NONE",
        /// The daemon has started and no frame has been processed yet.
        STARTING = 1 => "STARTING",
        /// No scene is loaded: odometry is given, the map pose is NaN.
        NO_SCENE = 2 => "NO_SCENE",
        /// The weights were never trained: the numbers exercise the system and mean nothing.
        UNTRAINED_MODEL = 3 => "UNTRAINED_MODEL",
        /// The network gave NaN or infinity; its state was reset.
        NON_FINITE_OUTPUT = 4 => "NON_FINITE_OUTPUT",
        /// The frame's time jumped ahead; the relative motion was reset.
        TIME_JUMP = 5 => "TIME_JUMP",
        /// The global pose contradicts the motion; the map pose follows odometry.
        INNOVATION_REJECTED = 6 => "INNOVATION_REJECTED",
        /// The camera or the recording gives no frames.
        SOURCE_LOST = 7 => "SOURCE_LOST",
        /// The recording has ended.
        SOURCE_ENDED = 8 => "SOURCE_ENDED",
        /// An operator paused the pipeline.
        PAUSED = 9 => "PAUSED",
        /// The map pose was re-initialised after a run of rejections, and may have jumped.
        REINITIALIZED = 10 => "REINITIALIZED",
        /// Odometry was just reset: by request, or because frames were missing for too long.
        ODOMETRY_RESET = 11 => "ODOMETRY_RESET",
        /// The relative pose head is not trained: no odometry.
        NO_ODOMETRY = 12 => "NO_ODOMETRY",
        /// The daemon is stopping: this is its last sample.
        STOPPING = 13 => "STOPPING",
    }
}

wire_enum! {
    /// The clock of `capture_time_ns`.
    CaptureClock {
        /// There is no time of capture: no frame belongs to this sample.
        UNKNOWN = 0 => "UNKNOWN",
        /// `CLOCK_MONOTONIC` of this machine.
        MONOTONIC = 1 => "MONOTONIC",
        /// The recording's own time stamps.
        RECORDED = 2 => "RECORDED",
    }
}

wire_enum! {
    /// The daemon's health in one word.
    Health {
        /// Nobody said.
        UNKNOWN = 0 => "UNKNOWN",
        /// Loading; no frame processed yet.
        STARTING = 1 => "STARTING",
        /// Everything works.
        OK = 2 => "OK",
        /// Works with a reservation: untrained, dropping frames, poses rejected.
        DEGRADED = 3 => "DEGRADED",
        /// No frames; the daemon keeps trying.
        WAITING_FOR_SOURCE = 4 => "WAITING_FOR_SOURCE",
        /// Paused by request.
        PAUSED = 5 => "PAUSED",
        /// Stopping.
        STOPPING = 6 => "STOPPING",
        /// Somebody must act: see the last error.
        FAILED = 7 => "FAILED",
    }
}

wire_enum! {
    /// What the frame source is doing.
    SourceState {
        /// Nobody said.
        UNKNOWN = 0 => "UNKNOWN",
        /// Being opened.
        OPENING = 1 => "OPENING",
        /// Frames arrive.
        STREAMING = 2 => "STREAMING",
        /// Gone; the daemon tries to reopen it.
        LOST = 3 => "LOST",
        /// A recording that has ended.
        ENDED = 4 => "ENDED",
    }
}

wire_enum! {
    /// Where the weights come from.
    Provenance {
        /// Nobody said.
        UNKNOWN = 0 => "UNKNOWN",
        /// Drawn from a random generator: the numbers exercise the system and mean nothing.
        UNTRAINED = 1 => "UNTRAINED",
        /// Trained.
        TRAINED = 2 => "TRAINED",
    }
}

wire_enum! {
    /// Who may subscribe, as the running daemon has it.
    Access {
        /// Nobody said.
        UNKNOWN = 0 => "unknown",
        /// Programs of the daemon's own user, and root.
        USER = 1 => "user",
        /// Members of one group, and root.
        GROUP = 2 => "group",
        /// Every local user.
        EVERYONE = 3 => "everyone",
    }
}

wire_enum! {
    /// Is the daemon writing a recording?
    Recording {
        /// Nobody said.
        UNKNOWN = 0 => "UNKNOWN",
        /// No.
        OFF = 1 => "OFF",
        /// Yes.
        ON = 2 => "ON",
    }
}

wire_enum! {
    /// What a [`ControlRequest`](crate::ControlRequest) asks for.
    Command {
        /// Nothing: an all-zero request, always refused.
        NONE = 0 => "none",
        /// The daemon's status, in the reply.
        STATUS = 1 => "status",
        /// Restart odometry at identity; `reset_epoch` grows, `map` is untouched.
        RESET_ODOMETRY = 2 => "reset-odometry",
        /// The base is at `map_from_base` now.
        SET_POSE = 3 => "set-pose",
        /// Load the scene file named by `text`.
        LOAD_SCENE = 4 => "load-scene",
        /// Forget the scene called `text`.
        UNLOAD_SCENE = 5 => "unload-scene",
        /// Use the loaded scene called `text`.
        SELECT_SCENE = 6 => "select-scene",
        /// Stop processing frames; samples with reason PAUSED go out.
        PAUSE = 7 => "pause",
        /// Process frames again.
        RESUME = 8 => "resume",
        /// Record the stream to the file named by `text`, or to the configured folder when it is empty.
        START_RECORDING = 9 => "start-recording",
        /// End the recording.
        STOP_RECORDING = 10 => "stop-recording",
    }
}

wire_enum! {
    /// What became of a request.
    Outcome {
        /// Nobody said.
        UNKNOWN = 0 => "UNKNOWN",
        /// Done.
        DONE = 1 => "DONE",
        /// The request makes no sense (unknown command, non-finite pose, empty name).
        INVALID = 2 => "INVALID",
        /// The request makes sense but not now (nothing is recorded, the scene is not loaded).
        REFUSED = 3 => "REFUSED",
        /// It was tried and failed; the message says why, and the old state is kept.
        FAILED = 4 => "FAILED",
        /// This daemon cannot do that.
        UNSUPPORTED = 5 => "UNSUPPORTED",
    }
}

impl Status {
    /// May the poses of a sample with this status be finite? An unknown status may not.
    pub fn may_have_pose(self) -> bool {
        matches!(self, Self::INITIALIZING | Self::TRACKING | Self::DEGRADED)
    }
}

impl Command {
    /// Does it change what the daemon does? Such requests may belong to another group.
    pub fn changes_state(self) -> bool {
        !matches!(self, Self::NONE | Self::STATUS)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_unknown_value_is_readable() {
        assert_eq!(Status(77).to_string(), "UNKNOWN(77)");
        assert_eq!(Status(77).name(), None);
        assert!(!Status(77).may_have_pose());
        assert_eq!(format!("{:>12}|", Status::LOST), "        LOST|");
    }

    #[test]
    fn values_and_names_are_distinct() {
        for (index, (value, name)) in Reason::ALL.iter().enumerate() {
            assert_eq!(value.0 as usize, index);
            assert_eq!(Reason::ALL.iter().filter(|(_, other)| other == name).count(), 1);
        }
    }
}
