//! The control thread: answers requests, loads scenes, and clears away what killed clients left behind, all of
//! it off the path of the poses.

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Sender, bounded, select};
use grnet_proto::clock::Now;
use grnet_proto::{
    Command, ControlReply, ControlRequest, ControlServer, Node, Outcome, Role, SCHEMA_VERSION,
};

use crate::activity::Activity;
use crate::convert;
use crate::failure::Failure;
use crate::record::{Ask, Asked};
use crate::reload::Reloader;
use crate::scenes::{SceneError, SceneLibrary};
use crate::setup::Transport;
use crate::state::State;
use crate::stop::Stop;
use crate::worker::{Change, Order};

/// Longest wait for a request before the stop is looked at.
const WAIT: Duration = Duration::from_millis(100);

/// How often the leftovers of killed clients are looked for.
const CLEAN_UP: Duration = Duration::from_secs(2);

/// The answer to who went round the folder of the control group.
const FOR_ANOTHER_GROUP: &str =
    "requests that change the daemon's state are for members of publish.control_group";

/// What the control thread works with.
#[derive(Debug)]
pub struct Control {
    /// Who may subscribe, and where.
    pub transport: Transport,
    /// Gets one message when the camera's name is ours.
    pub opened: Receiver<()>,
    /// Gets one message when requests are answered.
    pub controlled: Sender<()>,
    /// Which scenes there are.
    pub scenes: SceneLibrary,
    /// Orders to the worker.
    pub orders: Sender<Order>,
    /// SIGHUP came.
    pub reloads: Receiver<()>,
    /// What a reload works with.
    pub reloader: Reloader,
    /// Requests to the recorder.
    pub recorder: Sender<Asked>,
    /// What is told.
    pub state: Arc<State>,
    /// Ends the thread.
    pub stop: Stop,
    /// Shows progress.
    pub activity: Activity,
}

/// What became of a request, in words.
pub type Answer = (Outcome, String);

/// Answers requests until the stop comes.
///
/// # Errors
/// When the port cannot be opened, or shared memory is corrupt.
pub fn run(mut control: Control) -> Result<(), Failure> {
    select! {
        recv(control.opened) -> opened => if opened.is_err() {
            return Ok(());
        },
        recv(control.stop.channel()) -> _ => return Ok(()),
    }
    control.activity.work();
    let node = Node::open(control.transport.access, &control.transport.root, Role::Daemon)?;
    let server = ControlServer::open(&node, &control.state.identity.camera)?;
    control.state.set_scenes(control.scenes.list());
    // A publisher that has gone has told why.
    let _ = control.controlled.try_send(());

    let mut cleaned = Instant::now();
    while !control.stop.is_stopped() {
        control.activity.work();
        while let Some(pending) = server.receive()? {
            let request = pending.request();
            let (outcome, message) = if request.command.changes_state() && !pending.may_change_state() {
                (Outcome::REFUSED, FOR_ANOTHER_GROUP.to_owned())
            } else {
                control.answer(&request)
            };
            if request.command == Command::STATUS {
                tracing::debug!(command = %request.command, %outcome, "request");
            } else {
                tracing::info!(command = %request.command, %outcome, message, "request");
            }
            let status = control.state.status(Now::read());
            pending.reply(&ControlReply::new(&request, outcome, &message, status))?;
        }
        // Several signals that came meanwhile ask for one reload.
        if control.reloads.try_iter().count() > 0 {
            control.reload();
        }
        if cleaned.elapsed() >= CLEAN_UP {
            cleaned = Instant::now();
            let done = node.cleanup_dead_nodes();
            if done.removed > 0 {
                tracing::info!(removed = done.removed, "cleared away what killed processes left behind");
            }
        }
        control.activity.work();
        server.wait(WAIT)?;
    }
    control.activity.wait();
    Ok(())
}

impl Control {
    fn answer(&mut self, request: &ControlRequest) -> Answer {
        if request.schema_version != SCHEMA_VERSION {
            let found = request.schema_version;
            let text = format!("the request is of schema {found}, this daemon speaks {SCHEMA_VERSION}");
            return (Outcome::INVALID, text);
        }
        let text = request.text.to_string();
        match request.command {
            Command::STATUS => (Outcome::DONE, "the status is in the reply".into()),
            Command::RESET_ODOMETRY => self.order(Change::ResetOdometry),
            Command::SET_POSE => match convert::requested_pose(request) {
                Ok((pose, covariance)) => self.order(Change::SetPose(pose, covariance.into())),
                Err(problem) => (Outcome::INVALID, problem),
            },
            Command::PAUSE => self.order(Change::Pause),
            Command::RESUME => self.order(Change::Resume),
            Command::LOAD_SCENE | Command::UNLOAD_SCENE | Command::SELECT_SCENE if text.is_empty() => {
                (Outcome::INVALID, format!("{} needs the name or path of a scene", request.command))
            }
            Command::LOAD_SCENE => self.scene(|control| control.load_scene(&text)),
            Command::UNLOAD_SCENE => self.scene(|control| control.unload_scene(&text)),
            Command::SELECT_SCENE => self.scene(|control| control.select_scene(&text)),
            Command::START_RECORDING if !text.is_empty() && Path::new(&text).is_relative() => {
                (Outcome::INVALID, format!("{text} is not an absolute path"))
            }
            Command::START_RECORDING => self.record(Ask::Start((!text.is_empty()).then(|| text.into()))),
            Command::STOP_RECORDING => self.record(Ask::Stop),
            unknown => (Outcome::INVALID, format!("{unknown} is no command of this daemon")),
        }
    }

    /// Loading takes as long as the disk takes: that is no lack of progress of the pose stream.
    fn scene(&mut self, work: impl FnOnce(&mut Self) -> Result<String, SceneError>) -> Answer {
        self.activity.wait();
        let result = work(self);
        self.activity.work();
        self.state.set_scenes(self.scenes.list());
        match result {
            Ok(done) => (Outcome::DONE, done),
            Err(SceneError::Invalid(problem)) => (Outcome::INVALID, problem),
            Err(SceneError::Refused(problem)) => (Outcome::REFUSED, problem),
            Err(SceneError::Failed(problem)) => (Outcome::FAILED, problem),
        }
    }

    fn load_scene(&mut self, path: &str) -> Result<String, SceneError> {
        self.scenes.load(Path::new(path))
    }

    fn select_scene(&mut self, name: &str) -> Result<String, SceneError> {
        if self.scenes.is_active(name) {
            return Ok(format!("scene in use: {name}, as before"));
        }
        let prepared = self.scenes.prepare_selected(name)?;
        let done = self.change(Change::Swap(Box::new(prepared))).map_err(SceneError::Failed)?;
        self.scenes.selected(name);
        Ok(done)
    }

    fn unload_scene(&mut self, name: &str) -> Result<String, SceneError> {
        let replacement = self.scenes.prepare_without(name)?;
        let done = match replacement {
            Some(prepared) => self.change(Change::Swap(Box::new(prepared))).map_err(SceneError::Failed)?,
            None => "it was not in use".to_owned(),
        };
        self.scenes.remove(name, &self.state.model());
        Ok(format!("scene {name} is unloaded; {done}"))
    }

    /// Asks the recorder, which answers between two frames.
    pub(crate) fn record(&self, ask: Ask) -> Answer {
        self.activity.wait();
        let (reply, answer) = bounded(1);
        let ending = || (Outcome::FAILED, "the daemon is ending".into());
        let stop = self.stop.channel();
        let asked = select! {
            send(self.recorder, (ask, reply)) -> sent => sent.is_ok(),
            recv(stop) -> _ => false,
        };
        if !asked {
            return ending();
        }
        let answer = select! {
            recv(answer) -> answer => answer.unwrap_or_else(|_| ending()),
            recv(stop) -> _ => ending(),
        };
        self.activity.work();
        answer
    }

    fn order(&self, what: Change) -> Answer {
        match self.change(what) {
            Ok(done) => (Outcome::DONE, done),
            Err(problem) => (Outcome::FAILED, problem),
        }
    }

    /// Asks the worker, which answers between two frames.
    pub(crate) fn change(&self, what: Change) -> Result<String, String> {
        const ENDING: &str = "the daemon is ending";
        self.activity.wait();
        let (reply, answer) = bounded(1);
        let stop = self.stop.channel();
        select! {
            send(self.orders, Order { what, reply }) -> sent => sent.map_err(|_| ENDING)?,
            recv(stop) -> _ => return Err(ENDING.into()),
        }
        let answer = select! {
            recv(answer) -> answer => answer.unwrap_or_else(|_| Err(ENDING.into())),
            recv(stop) -> _ => Err(ENDING.into()),
        };
        self.activity.work();
        answer
    }
}
