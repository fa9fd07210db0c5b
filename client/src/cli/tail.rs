//! `grnet-client tail`.

use std::{
    io::{self, BufWriter, StdoutLock, Write as _},
    sync::atomic::{AtomicBool, Ordering},
    time::{Duration, Instant},
};

use clap::ValueEnum as _;
use grnet_client::{BootId, ClientError, Connection, PoseSubscriber, Reason, Sample};

use super::{TailArgs, print::Printer, reference::Reference};

/// How long a signal can take to be noticed while no sample comes.
const NOTICE_SIGNAL: Duration = Duration::from_millis(100);

/// Prints samples until the count is reached, the timeout passes, a signal comes or the reader goes.
pub fn run(connection: &Connection, args: &TailArgs, stop: &AtomicBool) -> anyhow::Result<()> {
    let reference = args.reference.as_deref().map(Reference::read).transpose()?;
    let Some(mut subscriber) = open(connection, args, stop)? else { return Ok(()) };
    let mut tail = Tail::new(args, reference);
    let result = tail.follow(&mut subscriber, args, stop);
    tail.out.flush()?;
    if let Some(summary) = tail.printer.summary() {
        eprintln!("grnet-client: {summary}");
    }
    if tail.hidden > 0 {
        let which =
            args.pose.to_possible_value().map(|value| value.get_name().to_owned()).unwrap_or_default();
        eprintln!("grnet-client: {} samples had no {which} pose and were not printed", tail.hidden);
    }
    result
}

/// Subscribes; `None` when a signal came while there was no daemon yet.
fn open(
    connection: &Connection,
    args: &TailArgs,
    stop: &AtomicBool,
) -> Result<Option<PoseSubscriber>, ClientError> {
    let started = Instant::now();
    loop {
        match PoseSubscriber::open(connection) {
            Err(ClientError::NoDaemon(_)) if args.wait.is_some_and(|wait| started.elapsed() < wait) => {
                if stop.load(Ordering::Relaxed) {
                    return Ok(None);
                }
                // A service that does not exist has no event that could be waited for.
                std::thread::sleep(NOTICE_SIGNAL);
            }
            opened => return opened.map(Some),
        }
    }
}

struct Tail<'args> {
    args: &'args TailArgs,
    printer: Printer,
    out: BufWriter<StdoutLock<'static>>,
    printed: u64,
    hidden: u64,
    due_ns: Option<u64>,
    last_printable: Instant,
    boot_id: Option<BootId>,
    daemon_was_there: bool,
}

impl<'args> Tail<'args> {
    fn new(args: &'args TailArgs, reference: Option<Reference>) -> Self {
        Self {
            args,
            printer: Printer::new(args.format(), args.pose, reference),
            out: BufWriter::new(io::stdout().lock()),
            printed: 0,
            hidden: 0,
            due_ns: None,
            last_printable: Instant::now(),
            boot_id: None,
            daemon_was_there: true,
        }
    }

    fn follow(
        &mut self,
        subscriber: &mut PoseSubscriber,
        args: &TailArgs,
        stop: &AtomicBool,
    ) -> anyhow::Result<()> {
        while !stop.load(Ordering::Relaxed) {
            let patience = self.patience();
            let next = match subscriber.try_next()? {
                Some(sample) => Ok(sample),
                None => {
                    // Only when nothing waits: a burst is written in one go.
                    self.out.flush()?;
                    subscriber.next_within(patience)
                }
            };
            match next {
                Ok(mut sample) => {
                    if args.latest {
                        while let Some(newer) = subscriber.try_next()? {
                            sample = newer;
                        }
                    }
                    self.announce(&sample);
                    self.take(&sample, subscriber.lost_samples())?;
                    let last_word = matches!(sample.reason(), Reason::SOURCE_ENDED | Reason::STOPPING);
                    if args.count.is_some_and(|count| self.printed >= count) || (args.until_end && last_word)
                    {
                        return Ok(());
                    }
                }
                Err(error @ (ClientError::Timeout { .. } | ClientError::NoDaemon(_))) => {
                    self.mourn(&error);
                    self.give_up_when_due(subscriber.has_daemon(), error)?;
                }
                Err(error) => return Err(error.into()),
            }
        }
        Ok(())
    }

    /// How long to wait for the next sample: signals and the user's timeout want to be noticed.
    fn patience(&self) -> Duration {
        match self.args.timeout {
            Some(timeout) => timeout.saturating_sub(self.last_printable.elapsed()).min(NOTICE_SIGNAL),
            None => NOTICE_SIGNAL,
        }
    }

    fn give_up_when_due(&self, has_daemon: bool, error: ClientError) -> Result<(), ClientError> {
        let Some(timeout) = self.args.timeout else { return Ok(()) };
        if self.last_printable.elapsed() < timeout {
            return Ok(());
        }
        Err(match error {
            ClientError::Timeout { service, .. } if has_daemon => {
                ClientError::Timeout { service, expected: "printable sample", waited: timeout }
            }
            error => error,
        })
    }

    fn take(&mut self, sample: &Sample, lost_samples: u64) -> anyhow::Result<()> {
        if !self.printer.shows(sample) {
            self.hidden += 1;
            if self.args.timeout.is_some_and(|timeout| self.last_printable.elapsed() >= timeout) {
                return Err(ClientError::Timeout {
                    service: format!("grnet/{}/pose", sample.raw().camera),
                    expected: "printable sample",
                    waited: self.last_printable.elapsed(),
                }
                .into());
            }
            return Ok(());
        }
        self.last_printable = Instant::now();
        self.printer.compare(sample);
        if self.is_due(sample.raw().publish_time_ns) {
            self.out.write_all(self.printer.text(sample, lost_samples).as_bytes())?;
            self.printed += 1;
        }
        Ok(())
    }

    /// Thins to the asked rate by the time of publication, so that bursts do not distort it.
    fn is_due(&mut self, publish_time_ns: u64) -> bool {
        let Some(rate_hz) = self.args.rate else { return true };
        let period_ns = (1e9 / rate_hz) as u64;
        match self.due_ns {
            Some(due_ns) if publish_time_ns < due_ns && due_ns - publish_time_ns <= period_ns => false,
            Some(due_ns) if publish_time_ns.abs_diff(due_ns) < period_ns => {
                self.due_ns = Some(due_ns + period_ns);
                true
            }
            _ => {
                self.due_ns = Some(publish_time_ns.saturating_add(period_ns));
                true
            }
        }
    }

    /// Says when another run of the daemon speaks.
    fn announce(&mut self, sample: &Sample) {
        let boot_id = sample.boot_id();
        match self.boot_id {
            Some(old) if old != boot_id => {
                eprintln!("grnet-client: the daemon restarted: boot {boot_id} follows {old}");
            }
            _ => {}
        }
        self.boot_id = Some(boot_id);
        self.daemon_was_there = true;
    }

    /// Says once when the daemon has gone.
    fn mourn(&mut self, error: &ClientError) {
        if matches!(error, ClientError::NoDaemon(_)) && self.daemon_was_there {
            eprintln!("grnet-client: the daemon has gone; waiting for it to come back");
            self.daemon_was_there = false;
        }
    }
}
