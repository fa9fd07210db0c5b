//! Requests that change the daemon's state, and its answers.

use iceoryx2::prelude::ZeroCopySend;

use super::{BootId, Command, DaemonStatus, FixedText, Outcome, SCHEMA_VERSION, layout::wire_struct};

wire_struct! {
    /// A request on `grnet/<camera>/control`.
    ControlRequest, type_name = "grnet.ControlRequest.v1", size = 1152, align = 8 {
        /// Version of the message: [`SCHEMA_VERSION`].
        0 => schema_version: u32,
        /// What is asked for.
        4 => command: Command,
        /// Chosen by the client; the reply repeats it.
        8 => request_id: u64,
        /// For [`Command::SET_POSE`]: where the base is in the map, metres. Otherwise NaN.
        16 => map_from_base_translation_m: [f64; 3],
        /// For [`Command::SET_POSE`]: unit quaternion x, y, z, w. Otherwise NaN.
        40 => map_from_base_quaternion_xyzw: [f64; 4],
        /// The name or path that the command needs; a path is the daemon's, absolute.
        72 => text: FixedText<1024>,
        /// For [`Command::SET_POSE`]: standard deviation of the translation along each axis, metres; 0 when not
        /// known.
        1096 => translation_stddev_m: f64,
        /// For [`Command::SET_POSE`]: standard deviation of the rotation about each axis, radians; 0 when not
        /// known.
        1104 => rotation_stddev_rad: f64,
        /// Zero; room for later fields of this version.
        1112 => reserved: [u64; 5],
    }
}

wire_struct! {
    /// The answer to a [`ControlRequest`].
    ControlReply, type_name = "grnet.ControlReply.v1", size = 2944, align = 8 {
        /// Version of the message: [`SCHEMA_VERSION`].
        0 => schema_version: u32,
        /// What became of the request.
        4 => outcome: Outcome,
        /// The id that the client chose.
        8 => request_id: u64,
        /// This run of the daemon.
        16 => boot_id: BootId,
        /// What was done, or why not and what to do.
        32 => message: FixedText<512>,
        /// The daemon's state after the request.
        544 => status: DaemonStatus,
        /// Zero; room for later fields of this version.
        2848 => reserved: [u64; 12],
    }
}

impl ControlRequest {
    /// A request without arguments.
    pub fn new(command: Command) -> Self {
        Self {
            schema_version: SCHEMA_VERSION,
            command,
            request_id: 0,
            map_from_base_translation_m: [f64::NAN; 3],
            map_from_base_quaternion_xyzw: [f64::NAN; 4],
            text: FixedText::EMPTY,
            translation_stddev_m: 0.0,
            rotation_stddev_rad: 0.0,
            reserved: [0; 5],
        }
    }

    /// A request about something with a name or a path, `None` when it is too long for the message:
    /// half a path names another file.
    pub fn with_text(command: Command, text: &str) -> Option<Self> {
        let request = Self { text: FixedText::new(text), ..Self::new(command) };
        (request.text == text).then_some(request)
    }

    /// "The base is here": translation in metres and unit quaternion x, y, z, w in the map.
    pub fn set_pose(translation_m: [f64; 3], quaternion_xyzw: [f64; 4]) -> Self {
        Self {
            map_from_base_translation_m: translation_m,
            map_from_base_quaternion_xyzw: quaternion_xyzw,
            ..Self::new(Command::SET_POSE)
        }
    }

    /// The same with how well that pose is known: what the network says has then to agree with it.
    pub fn with_stddev(self, translation_stddev_m: f64, rotation_stddev_rad: f64) -> Self {
        Self { translation_stddev_m, rotation_stddev_rad, ..self }
    }
}

impl ControlReply {
    /// The answer to `request`, in words and with the daemon's state after it.
    pub fn new(request: &ControlRequest, outcome: Outcome, message: &str, status: DaemonStatus) -> Self {
        Self {
            schema_version: SCHEMA_VERSION,
            outcome,
            request_id: request.request_id,
            boot_id: status.boot_id,
            message: FixedText::new(message),
            status,
            reserved: [0; 12],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_path_is_never_cut() {
        assert!(ControlRequest::with_text(Command::LOAD_SCENE, &"x".repeat(1024)).is_some());
        assert!(ControlRequest::with_text(Command::LOAD_SCENE, &"x".repeat(1025)).is_none());
        assert!(ControlRequest::with_text(Command::LOAD_SCENE, "a\0b").is_none());
    }
}
