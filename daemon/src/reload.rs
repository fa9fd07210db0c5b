//! SIGHUP: the configuration is read again. What can be changed while frames flow is changed, the rest is named; a
//! configuration that cannot be used changes nothing.

use std::sync::Arc;
use std::time::Duration;

use crossbeam_channel::Sender;
use grnet_config::{GrnetdConfig, Settings};

use crate::control::Control;
use crate::logging::LogHandle;
use crate::record::{Ask, Recorder};
use crate::run::Loaded;
use crate::service_manager::ServiceManager;
use crate::setup::pipeline_options;
use crate::worker::Change;

/// What is running, to be compared with what the file says now.
#[derive(Debug)]
pub struct Reloader {
    /// The configuration that runs.
    pub loaded: Loaded,
    /// Changes the log's level.
    pub log: LogHandle,
    /// Times between heartbeats, to the publisher.
    pub heartbeats: Sender<Duration>,
    /// Is told when it begins and ends.
    pub manager: Arc<ServiceManager>,
}

/// What a key that can be reloaded belongs to; each is applied as a whole.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Section {
    Log,
    Tracking,
    Scene,
    StatusRate,
    Record,
}

fn section(key: &str) -> Option<Section> {
    match key {
        "log.level" => Some(Section::Log),
        "model.scene" => Some(Section::Scene),
        "publish.status_rate_hz" => Some(Section::StatusRate),
        "record.folder" | "record.format" | "record.jpeg_quality" | "record.least_free_mib" => {
            Some(Section::Record)
        }
        _ => key.starts_with("tracking.").then_some(Section::Tracking),
    }
}

/// What a new configuration changes.
#[derive(Debug, Default, PartialEq, Eq)]
struct Plan {
    now: Vec<&'static str>,
    at_restart: Vec<&'static str>,
}

impl Plan {
    fn new(running: &Settings, new: &Settings) -> Self {
        let changed = running.differences(new);
        // A scene belongs to its trunk.
        let other_trunk = changed.contains(&"model.checkpoint");
        let can_be_now =
            |key: &&str| section(key).is_some_and(|part| !(other_trunk && part == Section::Scene));
        let (now, at_restart) = changed.into_iter().partition(can_be_now);
        Self { now, at_restart }
    }

    fn changes(&self, part: Section) -> bool {
        self.now.iter().any(|key| section(key) == Some(part))
    }
}

impl Control {
    /// Reads the configuration again and applies it.
    pub fn reload(&mut self) {
        self.reloader.manager.reloading();
        if let Err(problem) = self.try_reload() {
            tracing::warn!("the configuration was not reloaded, the old one goes on: {problem}");
            self.state.report_error(format!("the configuration was not reloaded: {problem}"));
        }
        self.reloader.manager.reloaded();
    }

    fn try_reload(&mut self) -> Result<(), String> {
        let Loaded { path, overrides, settings, .. } = &self.reloader.loaded;
        let (config, new) =
            GrnetdConfig::load_with_settings(path, overrides).map_err(|error| error.to_string())?;
        let plan = Plan::new(settings, &new);
        // What can fail comes first, so that a failure leaves everything as it was.
        if plan.changes(Section::Scene) {
            self.configure_scene(config.model.scene.as_deref())?;
        }
        if plan.changes(Section::Log) {
            self.reloader.log.set_level(&config.log.level).map_err(|failure| failure.chain())?;
        }
        if plan.changes(Section::Tracking) {
            let options = pipeline_options(&config);
            self.change(Change::Tracking {
                time: options.time,
                gate: options.gate,
                map_smoothing_s: options.map_smoothing_s,
                initializing_frames: options.initializing_frames,
            })?;
        }
        if plan.changes(Section::StatusRate) {
            // A publisher that has gone has told why.
            let _ = self.reloader.heartbeats.send(config.publish.heartbeat());
        }
        let running = &mut self.reloader.loaded.config;
        if plan.changes(Section::Record) {
            running.record = config.record.clone();
            let recorder = Recorder::new(running, &self.state.identity);
            self.record(Ask::Configure(Box::new(recorder)));
        }
        for key in &plan.now {
            self.reloader.loaded.settings.adopt(key, &new);
        }
        tracing::info!(changed = plan.now.join(", "), "the configuration was reloaded");
        if !plan.at_restart.is_empty() {
            tracing::warn!(keys = plan.at_restart.join(", "), "changed keys that need a restart");
        }
        Ok(())
    }

    fn configure_scene(&mut self, path: Option<&std::path::Path>) -> Result<(), String> {
        self.activity.wait();
        let prepared = self.scenes.prepare_configured(path);
        self.activity.work();
        let prepared = prepared.map_err(|error| error.to_string())?;
        self.change(Change::Swap(Box::new(prepared)))?;
        self.scenes.configured(path, &self.state.model());
        self.state.set_scenes(self.scenes.list());
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settings(text: &str) -> Settings {
        Settings::parse(text, "grnetd.toml".as_ref(), &[]).unwrap()
    }

    fn plan(old: &str, new: &str) -> (Vec<&'static str>, Vec<&'static str>) {
        let Plan { now, at_restart } = Plan::new(&settings(old), &settings(new));
        (now, at_restart)
    }

    #[test]
    fn every_change_is_applied_or_named() {
        assert_eq!(plan("", "log.level = 'info'"), (vec![], vec![]));
        let text = "[source]\ndevice = '/dev/video7'\n[tracking]\ngate = false\n[publish]\nstatus_rate_hz = 5.0\n\
                    wait_for_subscribers = 1\n[record]\nqueue_frames = 7\nformat = 'jpeg'";
        let now = vec!["tracking.gate", "publish.status_rate_hz", "record.format"];
        let later = vec!["source.device", "publish.wait_for_subscribers", "record.queue_frames"];
        assert_eq!(plan("", text), (now, later));
    }

    #[test]
    fn a_scene_of_another_trunk_waits_for_it() {
        assert_eq!(plan("", "model.scene = 'a'"), (vec!["model.scene"], vec![]));
        let both = "[model]\nscene = 'a'\ncheckpoint = 'b'";
        assert_eq!(plan("", both), (vec![], vec!["model.checkpoint", "model.scene"]));
    }

    #[test]
    fn what_is_reloadable_is_a_key() {
        for key in ["log.level", "model.scene", "publish.status_rate_hz", "record.least_free_mib"] {
            assert!(
                grnet_config::KEYS.iter().any(|known| known.path == key) && section(key).is_some(),
                "{key}"
            );
        }
    }
}
