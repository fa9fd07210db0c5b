//! What is asked of the scheduler and of memory (`[realtime]`): applied, read back, and named when it is refused.

use std::collections::BTreeSet;
use std::fmt;
use std::io;

use grnet_config::RealtimeConfig;
use rustix::mm::{MlockAllFlags, mlockall};
use rustix::process::{Resource, getpriority_process, getrlimit, setpriority_process};
use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};
use thread_priority::{
    Error, RealtimeThreadSchedulePolicy, ThreadPriority, ThreadPriorityValue, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id, thread_schedule_policy_param,
};

use crate::failure::{Failure, Kind};

const FIFO: ThreadSchedulePolicy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);

/// Bit of CAP_IPC_LOCK in the capabilities that the kernel prints.
const CAP_IPC_LOCK: u64 = 1 << 14;

/// A thread that has settings of its own.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    /// Takes frames from the source.
    Capture,
    /// Computes poses.
    Worker,
    /// Publishes them.
    Publish,
}

/// Something that the system did not grant: what, why, and what would permit it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Refusal(String);

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// The settings of this run.
#[derive(Debug, Clone)]
pub struct Realtime {
    config: RealtimeConfig,
}

impl Realtime {
    /// Applies what holds for the whole process and tries what the threads will ask for, so that a refusal is known
    /// before anything runs. Call it before other threads are started: they inherit.
    ///
    /// # Errors
    /// The refusals, when `realtime.required` says that the daemon cannot do without.
    pub fn prepare(config: &RealtimeConfig) -> Result<(Self, Vec<Refusal>), Failure> {
        let realtime = Self { config: config.clone() };
        let mut refusals = realtime.apply_to_process();
        refusals.extend(realtime.try_threads()?);
        refusals.extend(realtime.start_helpers());
        if config.required && !refusals.is_empty() {
            return Err(refused(&refusals));
        }
        Ok((realtime, refusals))
    }

    /// Applies the settings of the calling thread. What is refused here was refused before, unless a limit has
    /// changed since: it is logged.
    ///
    /// # Errors
    /// As [`Realtime::prepare`].
    pub fn enter(&self, part: Part) -> Result<(), Failure> {
        let refusals = self.apply_to_thread(part);
        for refusal in &refusals {
            tracing::debug!(%refusal, "real-time setting");
        }
        if self.config.required && !refusals.is_empty() { Err(refused(&refusals)) } else { Ok(()) }
    }

    /// What is configured, in words; empty when nothing is.
    pub fn describe(&self) -> String {
        let RealtimeConfig { nice, cpus, worker_cpus, lock_memory, .. } = &self.config;
        let mut parts = Vec::new();
        for part in [Part::Capture, Part::Worker, Part::Publish] {
            if let Some(priority) = self.priority(part) {
                parts.push(format!("{part} at SCHED_FIFO {priority}"));
            }
        }
        if let Some(nice) = nice {
            parts.push(format!("nice {nice}"));
        }
        if let Some(cpus) = cpus {
            parts.push(format!("CPUs {cpus:?}"));
        }
        if let Some(cpus) = worker_cpus {
            parts.push(format!("worker on CPUs {cpus:?}"));
        }
        if *lock_memory {
            parts.push("memory locked".into());
        }
        parts.join(", ")
    }

    /// What a user should know about the settings as they are.
    pub fn advice(&self) -> Option<String> {
        let worker = self.config.worker_priority?;
        let below =
            [Part::Capture, Part::Publish].into_iter().filter(|part| self.priority(*part) < Some(worker));
        let below: Vec<String> = below.map(|part| part.to_string()).collect();
        (!below.is_empty()).then(|| {
            format!(
                "realtime.worker_priority is above that of {}: where CPUs are few, they wait until the worker rests",
                below.join(" and ")
            )
        })
    }

    fn priority(&self, part: Part) -> Option<u8> {
        match part {
            Part::Capture => self.config.capture_priority,
            Part::Worker => self.config.worker_priority,
            Part::Publish => self.config.publish_priority,
        }
    }

    fn apply_to_process(&self) -> Vec<Refusal> {
        let RealtimeConfig { nice, cpus, lock_memory, .. } = &self.config;
        let nice = nice.map(|nice| set_nice(i32::from(nice)));
        let cpus = cpus.as_deref().map(|cpus| set_cpus("realtime.cpus", cpus));
        let memory = lock_memory.then(lock_all_memory);
        [nice, cpus, memory].into_iter().flatten().filter_map(Result::err).collect()
    }

    fn apply_to_thread(&self, part: Part) -> Vec<Refusal> {
        let cpus = self.config.worker_cpus.as_deref().filter(|_| part == Part::Worker);
        let cpus = cpus.map(|cpus| set_cpus("realtime.worker_cpus", cpus));
        let priority = self.priority(part).map(|priority| set_fifo(part, priority));
        [cpus, priority].into_iter().flatten().filter_map(Result::err).collect()
    }

    /// On a thread for each, which then ends.
    fn try_threads(&self) -> Result<Vec<Refusal>, Failure> {
        let failed =
            |what: &dyn fmt::Debug| Failure::internal(format!("cannot try real-time settings: {what:?}"));
        let mut refusals = Vec::new();
        for part in [Part::Capture, Part::Worker, Part::Publish] {
            let realtime = self.clone();
            let probe = std::thread::Builder::new()
                .name("realtime".into())
                .spawn(move || realtime.apply_to_thread(part))
                .map_err(|error| failed(&error))?;
            refusals.extend(probe.join().map_err(|panic| failed(&panic))?);
        }
        Ok(refusals)
    }

    /// The threads that compute for the worker get the worker's settings: they are started here and not, with
    /// whatever that thread has, by the first thread that computes.
    fn start_helpers(&self) -> Option<Refusal> {
        let RealtimeConfig { worker_priority, worker_cpus, .. } = &self.config;
        if worker_priority.is_none() && worker_cpus.is_none() {
            return None;
        }
        let realtime = self.clone();
        let mut pool = rayon::ThreadPoolBuilder::new()
            .thread_name(|index| format!("helper-{index}"))
            .start_handler(move |_| {
                // Refusals are those of the worker.
                realtime.apply_to_thread(Part::Worker);
            });
        if let Some(cpus) = worker_cpus {
            pool = pool.num_threads(cpus.len());
        }
        pool.build_global()
            .err()
            .map(|error| Refusal(format!("the worker's helpers have no settings: {error}")))
    }
}

impl fmt::Display for Part {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Capture => "capture",
            Self::Worker => "worker",
            Self::Publish => "publish",
        })
    }
}

fn refused(refusals: &[Refusal]) -> Failure {
    let all: Vec<String> = refusals.iter().map(Refusal::to_string).collect();
    let text = format!("{} (realtime.required = true)", all.join("; "));
    Failure::new(Kind::Permission, anyhow::Error::msg(text))
}

fn set_fifo(part: Part, priority: u8) -> Result<(), Refusal> {
    let key = format!("realtime.{part}_priority = {priority}");
    let refuse = |why: String| {
        let limit = limit(Resource::Rtprio);
        Refusal(format!(
            "{key} (SCHED_FIFO) was refused: {why}; the limit RLIMIT_RTPRIO is {limit}: set LimitRTPRIO={priority} or \
             more in the unit (`ulimit -r` in a shell), where the kernel and the container admit real-time at all"
        ))
    };
    let value = ThreadPriorityValue::try_from(priority).map_err(|why| refuse(why.to_owned()))?;
    let thread = thread_native_id();
    set_thread_priority_and_policy(thread, ThreadPriority::Crossplatform(value), FIFO)
        .map_err(|error| refuse(system(&error)))?;
    let (policy, got) = thread_schedule_policy_param(thread).map_err(|error| refuse(system(&error)))?;
    if (policy, got.sched_priority) == (FIFO, i32::from(priority)) {
        Ok(())
    } else {
        Err(refuse(format!("the system has {policy:?} at {} instead", got.sched_priority)))
    }
}

fn system(error: &Error) -> String {
    match error {
        Error::OS(code) => io::Error::from_raw_os_error(*code).to_string(),
        other => other.to_string(),
    }
}

fn set_nice(nice: i32) -> Result<(), Refusal> {
    let refuse = |why: String| {
        Refusal(format!(
            "realtime.nice = {nice} was refused: {why}; set LimitNICE={nice} in the unit (`ulimit -e` in a shell; \
             RLIMIT_NICE is {})",
            limit(Resource::Nice)
        ))
    };
    setpriority_process(None, nice).map_err(|error| refuse(io::Error::from(error).to_string()))?;
    match getpriority_process(None) {
        Ok(got) if got == nice => Ok(()),
        Ok(got) => Err(refuse(format!("it is {got}"))),
        Err(error) => Err(refuse(io::Error::from(error).to_string())),
    }
}

fn set_cpus(key: &str, cpus: &[usize]) -> Result<(), Refusal> {
    let refuse = |why: &str| {
        Refusal(format!(
            "{key} = {cpus:?} was refused: {why}; the CPUs of the service are set by the machine and by AllowedCPUs= \
             and CPUAffinity= of the unit (`nproc --all`, `taskset -p $$`)"
        ))
    };
    let mut set = CpuSet::new();
    for &cpu in cpus.iter().filter(|cpu| **cpu < CpuSet::MAX_CPU) {
        set.set(cpu);
    }
    sched_setaffinity(None, &set).map_err(|error| refuse(&io::Error::from(error).to_string()))?;
    let got = sched_getaffinity(None).map_err(|error| refuse(&io::Error::from(error).to_string()))?;
    let got: BTreeSet<usize> = (0..CpuSet::MAX_CPU).filter(|cpu| got.is_set(*cpu)).collect();
    if got.iter().eq(cpus) { Ok(()) } else { Err(refuse(&format!("only {got:?} can be used"))) }
}

/// Memory that is locked from now on can fail to be had at any later time: only where there is no limit.
fn lock_all_memory() -> Result<(), Refusal> {
    let refuse = |why: String| {
        let limit = limit(Resource::Memlock);
        Refusal(format!(
            "realtime.lock_memory was refused: {why}; the limit RLIMIT_MEMLOCK is {limit}: set LimitMEMLOCK=infinity in \
             the unit (`ulimit -l unlimited` in a shell)"
        ))
    };
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    if getrlimit(Resource::Memlock).current.is_some() && !may_lock(&status) {
        return Err(refuse("memory that is needed later could not be locked".into()));
    }
    mlockall(MlockAllFlags::CURRENT | MlockAllFlags::FUTURE)
        .map_err(|error| refuse(io::Error::from(error).to_string()))?;
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    match field(&status, "VmLck:") {
        Some("0") => Err(refuse("no memory is locked".into())),
        _ => Ok(()),
    }
}

/// Whether the process has the capability that no limit holds for.
fn may_lock(status: &str) -> bool {
    field(status, "CapEff:")
        .and_then(|digits| u64::from_str_radix(digits, 16).ok())
        .is_some_and(|capabilities| capabilities & CAP_IPC_LOCK != 0)
}

/// The first word after `name` in /proc/self/status.
fn field<'a>(status: &'a str, name: &str) -> Option<&'a str> {
    status.lines().find_map(|line| line.strip_prefix(name))?.split_whitespace().next()
}

fn limit(resource: Resource) -> String {
    getrlimit(resource).current.map_or("unlimited".into(), |limit| limit.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn capabilities_are_read_as_the_kernel_prints_them() {
        let status =
            |capabilities: &str| format!("Name:\tgrnetd\nCapEff:\t{capabilities}\nVmLck:\t     132 kB\n");
        assert!(may_lock(&status("000001ffffffffff")) && may_lock(&status("0000000000004000")));
        assert!(!may_lock(&status("0000000000000000")) && !may_lock(""));
        assert_eq!(field(&status("0"), "VmLck:"), Some("132"));
    }

    #[test]
    fn cpus_that_are_not_there_are_refused() {
        std::thread::spawn(|| {
            let before = sched_getaffinity(None).unwrap();
            let first = (0..CpuSet::MAX_CPU).find(|cpu| before.is_set(*cpu)).unwrap();
            assert_eq!(set_cpus("k", &[first]), Ok(()));
            let partly = set_cpus("realtime.cpus", &[first, 1023]).unwrap_err().to_string();
            assert!(partly.contains("only {") && partly.contains("realtime.cpus"), "{partly}");
            assert!(set_cpus("k", &[1023]).unwrap_err().to_string().contains("AllowedCPUs"));
        })
        .join()
        .unwrap();
    }

    #[test]
    fn a_worker_above_the_others_is_advised_against() {
        let advice = |capture_priority, worker_priority, publish_priority| {
            let config =
                RealtimeConfig { capture_priority, worker_priority, publish_priority, ..Default::default() };
            Realtime { config }.advice()
        };
        assert!(advice(None, Some(1), Some(1)).is_some_and(|text| text.contains("of capture:")));
        assert!(advice(None, Some(9), Some(8)).is_some_and(|text| text.contains("capture and publish")));
        assert_eq!((advice(Some(5), Some(5), Some(6)), advice(Some(5), None, None)), (None, None));
    }

    #[test]
    fn nothing_is_asked_for_by_default() {
        let (realtime, refusals) = Realtime::prepare(&RealtimeConfig::default()).unwrap();
        assert_eq!((realtime.describe(), refusals), (String::new(), Vec::new()));
    }
}
