//! `grnetd`: frames in, pose samples out.
//!
//! [`run::run`] reads as the data flows: capture -> slot of one -> worker (preprocess, infer, fuse) -> queue ->
//! publish. Every stage is a named thread; every wait can be ended by the [`stop::Stop`] token; every thread
//! ends with a `Result`, and the first error is the daemon's.
//!
//! | module | what it does |
//! |---|---|
//! | [`cli`] | command line, exit codes |
//! | [`setup`] | configuration to model, pipeline, source and transport |
//! | [`check`] | `grnetd check`: what would run |
//! | [`devices`] | `grnetd devices`: which cameras there are |
//! | [`run`] | the threads and their supervision |
//! | [`capture`], [`worker`], [`publish`], [`control`], [`record`] | one thread each |
//! | [`slot`] | between capture and worker: what happens to a frame that nobody has time for |
//! | [`convert`] | pipeline types to wire types, nowhere else |
//! | [`state`], [`latency`] | what the daemon knows about itself |
//! | [`reload`] | SIGHUP |
//! | [`scenes`] | loading and changing scenes while frames flow |
//! | [`logging`], [`service_manager`], [`signals`], [`realtime`] | stderr, systemd, Unix |
#![forbid(unsafe_code)]
#![deny(missing_docs)]

pub mod activity;
pub mod capture;
pub mod check;
pub mod cli;
pub mod control;
pub mod convert;
pub mod devices;
pub mod failure;
pub mod feed;
pub mod latency;
pub mod logging;
pub mod publish;
pub mod realtime;
pub mod record;
pub mod reload;
pub mod repeats;
pub mod run;
pub mod scenes;
pub mod service_manager;
pub mod setup;
pub mod signals;
pub mod slot;
pub mod state;
pub mod stop;
pub mod supervisor;
pub mod worker;
