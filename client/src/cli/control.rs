//! `grnet-client control`: requests to the daemon.

use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::{Args, Subcommand};
use grnet_client::{
    ClientError, Command as Request, Connection, ControlClient, ControlReply, DaemonStatus, Outcome,
};
use grnet_geometry::{
    Pose,
    nalgebra::{Translation3, UnitQuaternion},
    quaternion,
};
use serde_json::json;

use super::{human, json, positive, seconds, status};

/// Which request, and how its answer is printed.
#[derive(Debug, Args)]
pub struct ControlArgs {
    #[command(subcommand)]
    action: Action,

    /// Print the answer as one JSON object
    #[arg(long, global = true)]
    json: bool,

    /// Give up when the daemon has not answered for this long
    #[arg(long, global = true, value_name = "SECONDS", value_parser = seconds, default_value = "30")]
    timeout: Duration,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// Print the daemon's state, asked for now
    Status,
    /// Restart the odometry at the identity; the map pose is untouched
    Reset,
    SetPose(SetPoseArgs),
    /// Load the weights of a scene, to be selected later; the daemon's user must be able to read the file
    LoadScene {
        /// A file of kind "scene" that was trained on the daemon's trunk
        file: PathBuf,
    },
    /// Use a loaded scene; the odometry goes on
    SelectScene {
        /// One that `scenes` lists
        name: String,
    },
    /// Forget a loaded scene; when it is in use, the daemon goes on without one
    UnloadScene {
        /// One that `scenes` lists
        name: String,
    },
    /// List the loaded scenes
    Scenes,
    /// Take no frames until `resume`; samples say PAUSED
    Pause,
    /// Take frames again
    Resume,
    /// Write every frame of the source to disk
    StartRecording {
        /// A new or empty folder on the daemon's machine; without it a new one in record.folder
        folder: Option<PathBuf>,
    },
    /// End the recording
    StopRecording,
}

/// Say where the base is in the map now.
///
/// Without a scene the map pose follows the odometry from there. With one, the network's next pose is taken at once,
/// unless both standard deviations are given: it has then to agree with them.
#[derive(Debug, Args)]
struct SetPoseArgs {
    /// Position in the map, metres
    #[arg(allow_negative_numbers = true)]
    x: f64,

    /// Likewise
    #[arg(allow_negative_numbers = true)]
    y: f64,

    /// Likewise
    #[arg(allow_negative_numbers = true)]
    z: f64,

    /// Attitude as a quaternion; it is normalised [default: no rotation]
    #[arg(
        long,
        value_names = ["QX", "QY", "QZ", "QW"],
        num_args = 4,
        allow_negative_numbers = true,
        conflicts_with_all = ["rpy", "yaw"]
    )]
    quaternion: Option<Vec<f64>>,

    /// Attitude as roll, pitch and yaw in degrees: about the map's fixed x, then y, then z axis
    #[arg(
        long,
        value_names = ["ROLL", "PITCH", "YAW"],
        num_args = 3,
        allow_negative_numbers = true,
        conflicts_with = "yaw"
    )]
    rpy: Option<Vec<f64>>,

    /// Attitude of a base that stands level: the angle about the map's z axis in degrees
    #[arg(long, value_name = "DEG", allow_negative_numbers = true)]
    yaw: Option<f64>,

    /// Standard deviation of the position along each axis, metres
    #[arg(long, value_name = "M", value_parser = positive, requires = "stddev_deg")]
    stddev_m: Option<f64>,

    /// Standard deviation of the attitude about each axis, degrees
    #[arg(long, value_name = "DEG", value_parser = positive, requires = "stddev_m")]
    stddev_deg: Option<f64>,
}

/// The arguments make no request.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct UsageError(String);

/// Sends the request and prints the answer.
pub fn run(connection: &Connection, args: &ControlArgs) -> anyhow::Result<()> {
    let request = Prepared::new(&args.action)?;
    let mut client = ControlClient::open(connection, args.timeout)?;
    let answer = request.send(&mut client);
    let reply = match &answer {
        Ok(reply) | Err(ClientError::Refused(reply)) => reply,
        Err(_) => return Ok(answer.map(|_| ())?),
    };
    let text = match (args.json, &args.action) {
        (true, _) => format!("{}\n", reply_json(request.command(), reply)),
        // The error is printed as such.
        (false, _) if answer.is_err() => String::new(),
        (false, Action::Status) => status::report(&reply.status, human::colours()),
        (false, Action::Scenes) => scenes(&reply.status),
        (false, _) => format!("{}\n", reply.message),
    };
    let mut out = io::stdout().lock();
    out.write_all(text.as_bytes())?;
    out.flush()?;
    Ok(answer.map(|_| ())?)
}

/// The exit code for an answer that is not "done".
pub fn code(reply: &ControlReply) -> u8 {
    match reply.outcome {
        Outcome::INVALID => 2,
        Outcome::REFUSED => 75,
        Outcome::FAILED | Outcome::UNSUPPORTED => 78,
        _ => 70,
    }
}

/// A request whose arguments are in order.
enum Prepared {
    Plain(Request),
    Text(Request, String),
    Pose { map_from_base: Pose, stddev: Option<(f64, f64)> },
}

impl Prepared {
    fn new(action: &Action) -> anyhow::Result<Self> {
        Ok(match action {
            Action::Status | Action::Scenes => Self::Plain(Request::STATUS),
            Action::Reset => Self::Plain(Request::RESET_ODOMETRY),
            Action::SetPose(args) => Self::Pose {
                map_from_base: args.map_from_base()?,
                stddev: args.stddev_m.zip(args.stddev_deg).map(|(m, deg)| (m, deg.to_radians())),
            },
            Action::LoadScene { file } => Self::Text(Request::LOAD_SCENE, absolute(file)?),
            Action::SelectScene { name } => Self::Text(Request::SELECT_SCENE, name.clone()),
            Action::UnloadScene { name } => Self::Text(Request::UNLOAD_SCENE, name.clone()),
            Action::Pause => Self::Plain(Request::PAUSE),
            Action::Resume => Self::Plain(Request::RESUME),
            Action::StartRecording { folder: None } => Self::Plain(Request::START_RECORDING),
            Action::StartRecording { folder: Some(folder) } => {
                Self::Text(Request::START_RECORDING, absolute(folder)?)
            }
            Action::StopRecording => Self::Plain(Request::STOP_RECORDING),
        })
    }

    fn command(&self) -> Request {
        match self {
            Self::Plain(command) | Self::Text(command, _) => *command,
            Self::Pose { .. } => Request::SET_POSE,
        }
    }

    fn send(&self, client: &mut ControlClient) -> Result<Box<ControlReply>, ClientError> {
        match self {
            Self::Plain(command) => client.command(*command),
            Self::Text(command, text) => client.command_with(*command, text),
            Self::Pose { map_from_base, stddev: None } => client.set_pose(map_from_base),
            Self::Pose { map_from_base, stddev: Some((translation_m, rotation_rad)) } => {
                client.set_uncertain_pose(map_from_base, *translation_m, *rotation_rad)
            }
        }
    }
}

impl SetPoseArgs {
    fn map_from_base(&self) -> Result<Pose, UsageError> {
        let angle = |deg: f64| deg.to_radians();
        let rotation = match (&self.quaternion, &self.rpy, self.yaw) {
            (Some(q), ..) => quaternion::from_xyzw([q[0], q[1], q[2], q[3]])
                .map_err(|error| UsageError(format!("--quaternion cannot be used: {error}")))?,
            (None, Some(rpy), _) => {
                UnitQuaternion::from_euler_angles(angle(rpy[0]), angle(rpy[1]), angle(rpy[2]))
            }
            (None, None, yaw) => UnitQuaternion::from_euler_angles(0.0, 0.0, angle(yaw.unwrap_or(0.0))),
        };
        let &Self { x, y, z, .. } = self;
        let pose = Pose::from_parts(Translation3::new(x, y, z), rotation);
        let finite = [x, y, z].iter().chain(pose.rotation.coords.iter()).all(|value| value.is_finite());
        if finite { Ok(pose) } else { Err(UsageError("the pose is not finite".to_owned())) }
    }
}

/// The daemon has another working directory. Links stay links: the daemon follows them.
fn absolute(path: &Path) -> anyhow::Result<String> {
    let absolute = std::path::absolute(path)
        .map_err(|error| UsageError(format!("{} cannot be made absolute: {error}", path.display())))?;
    let text = absolute.into_os_string().into_string();
    Ok(text.map_err(|path| UsageError(format!("{} is not UTF-8", path.display())))?)
}

fn scenes(status: &DaemonStatus) -> String {
    let mut text = String::new();
    for scene in status.loaded_scenes() {
        let mark = if status.scene_in_use() == Some(scene) { '*' } else { ' ' };
        text += &format!("{mark} {} ({})\n", scene.name, scene.hash.short());
    }
    if text.is_empty() { "no scene is loaded: odometry only\n".to_owned() } else { text }
}

fn reply_json(command: Request, reply: &ControlReply) -> serde_json::Value {
    json!({
        "request": command.to_string(),
        "outcome": reply.outcome.to_string(),
        "message": reply.message.to_string(),
        "status": json::status(&reply.status),
    })
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Debug, Parser)]
    struct Line {
        #[command(flatten)]
        control: ControlArgs,
    }

    fn parse(arguments: &str) -> Result<ControlArgs, clap::Error> {
        let words = ["control"].into_iter().chain(arguments.split_whitespace());
        Line::try_parse_from(words).map(|line| line.control)
    }

    fn pose(arguments: &str) -> Pose {
        let Prepared::Pose { map_from_base, .. } = Prepared::new(&parse(arguments).unwrap().action).unwrap()
        else {
            panic!("{arguments} is no pose")
        };
        map_from_base
    }

    #[test]
    fn a_pose_can_be_given_in_three_ways() {
        let yaw = pose("set-pose 1 -2 0.5 --yaw 90");
        assert_eq!(yaw.translation.vector.as_slice(), [1.0, -2.0, 0.5]);
        for same in [
            "set-pose 1 -2 .5 --rpy 0 0 90",
            "set-pose 1 -2 .5 --quaternion 0 0 1 1",
            "set-pose --quaternion 0 0 -1 -1 -- 1 -2 .5",
        ] {
            assert!(pose(same).rotation.angle_to(&yaw.rotation) < 1e-12, "{same}");
        }
        // Fixed axes: the yaw turns what the roll has turned.
        let rpy = pose("set-pose 0 0 0 --rpy 90 0 90").rotation;
        let expected = UnitQuaternion::from_euler_angles(0.0, 0.0, 90f64.to_radians())
            * UnitQuaternion::from_euler_angles(90f64.to_radians(), 0.0, 0.0);
        assert!(rpy.angle_to(&expected) < 1e-12);
        assert_eq!(pose("set-pose 0 0 0"), Pose::identity());
    }

    #[test]
    fn what_is_no_pose_is_refused() {
        for wrong in [
            "set-pose 1 2",
            "set-pose 1 2 x",
            "set-pose 1 2 3 --quaternion 1 0 0",
            "set-pose 1 2 3 --yaw 1 --rpy 0 0 0",
            "set-pose 1 2 3 --stddev-m 1",
            "set-pose 1 2 3 --stddev-m 0 --stddev-deg 1",
        ] {
            assert!(parse(wrong).is_err(), "{wrong}");
        }
        for wrong in ["set-pose nan 0 0", "set-pose 0 0 0 --quaternion 0 0 0 0", "set-pose 0 0 0 --yaw inf"] {
            let error = Prepared::new(&parse(wrong).unwrap().action).err().expect(wrong);
            assert!(error.is::<UsageError>(), "{wrong}: {error}");
        }
    }

    #[test]
    fn paths_are_made_absolute() {
        let Prepared::Text(Request::LOAD_SCENE, path) =
            Prepared::new(&parse("load-scene kitchen.safetensors").unwrap().action).unwrap()
        else {
            panic!("no path")
        };
        assert_eq!(Path::new(&path), std::env::current_dir().unwrap().join("kitchen.safetensors"));
    }
}
