//! `[realtime]`: what the daemon asks of the system's scheduler and memory.

use serde::Deserialize;

use crate::convert::{Checked, Invalid, within};

/// `[realtime]`. Whatever is `None` is left as the system has it.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct RealtimeConfig {
    /// SCHED_FIFO priority of the thread that takes frames from the source.
    pub capture_priority: Option<u8>,
    /// SCHED_FIFO priority of the thread that computes poses and of those that help it.
    pub worker_priority: Option<u8>,
    /// SCHED_FIFO priority of the thread that publishes poses.
    pub publish_priority: Option<u8>,
    /// Nice value of all threads that have no real-time priority.
    pub nice: Option<i8>,
    /// CPUs that all threads may use, in order.
    pub cpus: Option<Vec<usize>>,
    /// CPUs that the worker and its helpers may use instead, in order.
    pub worker_cpus: Option<Vec<usize>>,
    /// Whether the process's memory is kept from being paged out.
    pub lock_memory: bool,
    /// Whether a refusal by the system ends the start.
    pub required: bool,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(crate) struct RawRealtime {
    capture_priority: Option<u8>,
    worker_priority: Option<u8>,
    publish_priority: Option<u8>,
    nice: Option<i8>,
    cpus: Option<Vec<usize>>,
    worker_cpus: Option<Vec<usize>>,
    lock_memory: bool,
    required: bool,
}

pub(crate) fn realtime(raw: RawRealtime) -> Checked<RealtimeConfig> {
    let priority = |key, value: Option<u8>| value.map(|value| within(key, value, 1, 99)).transpose();
    Ok(RealtimeConfig {
        capture_priority: priority("realtime.capture_priority", raw.capture_priority)?,
        worker_priority: priority("realtime.worker_priority", raw.worker_priority)?,
        publish_priority: priority("realtime.publish_priority", raw.publish_priority)?,
        nice: raw.nice.map(|nice| within("realtime.nice", nice, -20, 19)).transpose()?,
        cpus: raw.cpus.map(|cpus| set("realtime.cpus", cpus)).transpose()?,
        worker_cpus: raw.worker_cpus.map(|cpus| set("realtime.worker_cpus", cpus)).transpose()?,
        lock_memory: raw.lock_memory,
        required: raw.required,
    })
}

fn set(key: &'static str, mut cpus: Vec<usize>) -> Checked<Vec<usize>> {
    if cpus.is_empty() {
        return Err(Invalid { key, problem: "no CPU is left to run on".into() });
    }
    for &cpu in &cpus {
        within(key, cpu, 0, 1023)?;
    }
    cpus.sort_unstable();
    cpus.dedup();
    Ok(cpus)
}
