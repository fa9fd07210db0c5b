//! What the pose stream may say at this moment: a pose, or why there is none.

use std::time::{Duration, Instant};

use grnet_proto::{Reason, Status};

/// Decides between poses and invalid samples, so that no stale pose is ever the last word.
#[derive(Debug)]
pub struct Feed {
    silence: Option<Duration>,
    /// When the last sample with a frame went out, and how long the next may take.
    last: Option<(Instant, Duration)>,
    /// The last outage that was announced.
    announced: u64,
    /// The outages that lie before the last published sample.
    overcome: u64,
    is_paused: bool,
    is_stale: bool,
}

impl Feed {
    /// Before the first frame. `silence` is how long a live source may give no sample; `None`: for ever.
    pub fn new(silence: Option<Duration>) -> Self {
        Self { silence, last: None, announced: 0, overcome: 0, is_paused: false, is_stale: false }
    }

    /// May a sample go out whose frame was captured after `outages` outages? One from before the last announced
    /// outage may not: the stream has already said that the pose is not known.
    pub fn admits(&mut self, outages: u64, step_time: Duration, now: Instant) -> bool {
        if outages < self.announced || self.is_paused {
            return false;
        }
        // The announcement may come later than a frame that is already past the outage.
        self.overcome = outages;
        self.announced = outages;
        self.last = Some((now, step_time));
        self.is_stale = false;
        true
    }

    /// An outage begins; whether it has to be told (and is not over already).
    pub fn outage(&mut self, number: u64) -> bool {
        let is_news = number > self.announced;
        self.announced = self.announced.max(number);
        is_news
    }

    /// No samples until [`Feed::resume`].
    pub fn pause(&mut self) {
        self.is_paused = true;
    }

    /// Samples follow; until the first one no pose is known.
    pub fn resume(&mut self) {
        self.is_paused = false;
        self.last = None;
    }

    /// Whether an invalid sample has to be repeated now.
    pub fn has_no_pose(&mut self, now: Instant) -> bool {
        if let (Some(silence), Some((at, step_time))) = (self.silence, self.last) {
            // A network that is slower than the silence is no silence.
            self.is_stale = now.saturating_duration_since(at) > silence + 2 * step_time;
        }
        self.is_out() || self.is_paused || self.is_stale || self.last.is_none()
    }

    /// What to say while there is no pose.
    pub fn absence(&self) -> (Status, Reason) {
        if self.is_out() {
            (Status::SOURCE_LOST, Reason::SOURCE_LOST)
        } else if self.is_paused {
            (Status::LOST, Reason::PAUSED)
        } else if self.is_stale {
            (Status::LOST, Reason::SOURCE_LOST)
        } else {
            (Status::INITIALIZING, Reason::STARTING)
        }
    }

    fn is_out(&self) -> bool {
        self.announced > self.overcome
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP: Duration = Duration::from_millis(10);

    fn feed() -> (Feed, Instant) {
        (Feed::new(Some(Duration::from_millis(500))), Instant::now())
    }

    #[test]
    fn before_the_first_frame_the_stream_initializes() {
        let (mut feed, now) = feed();
        assert!(feed.has_no_pose(now));
        assert_eq!(feed.absence(), (Status::INITIALIZING, Reason::STARTING));
        assert!(feed.admits(0, STEP, now) && !feed.has_no_pose(now));
    }

    #[test]
    fn results_from_before_an_outage_are_not_published_after_it() {
        let (mut feed, now) = feed();
        assert!(feed.admits(0, STEP, now));
        assert!(feed.outage(1));
        assert_eq!(feed.absence(), (Status::SOURCE_LOST, Reason::SOURCE_LOST));
        assert!(!feed.admits(0, STEP, now) && feed.has_no_pose(now));
        assert!(feed.admits(1, STEP, now) && !feed.has_no_pose(now));
    }

    #[test]
    fn an_announcement_that_comes_late_is_no_news() {
        let (mut feed, now) = feed();
        assert!(feed.admits(1, STEP, now));
        assert!(!feed.outage(1) && !feed.has_no_pose(now));
    }

    #[test]
    fn frames_that_never_become_samples_make_the_pose_stale() {
        let (mut feed, now) = feed();
        feed.admits(0, STEP, now);
        assert!(!feed.has_no_pose(now + Duration::from_millis(515)));
        assert!(feed.has_no_pose(now + Duration::from_millis(525)));
        assert_eq!(feed.absence().0, Status::LOST);
        assert!(feed.admits(0, STEP, now) && !feed.has_no_pose(now));
    }

    #[test]
    fn a_slow_network_and_a_recording_without_pace_are_not_stale() {
        let (mut feed, now) = feed();
        feed.admits(0, Duration::from_secs(2), now);
        assert!(!feed.has_no_pose(now + Duration::from_secs(4)));
        let mut feed = Feed::new(None);
        feed.admits(0, STEP, now);
        assert!(!feed.has_no_pose(now + Duration::from_secs(1000)));
    }

    #[test]
    fn a_pause_is_named_and_ends_with_a_new_frame() {
        let (mut feed, now) = feed();
        feed.admits(0, STEP, now);
        feed.pause();
        assert!(feed.has_no_pose(now) && !feed.admits(0, STEP, now));
        assert_eq!(feed.absence(), (Status::LOST, Reason::PAUSED));
        feed.resume();
        assert!(feed.has_no_pose(now));
        assert_eq!(feed.absence(), (Status::INITIALIZING, Reason::STARTING));
        assert!(feed.admits(0, STEP, now) && !feed.has_no_pose(now));
    }
}
