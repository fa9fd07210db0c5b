//! Made recordings played at every pace.

use std::time::{Duration, Instant};

use grnet_frame::{Clock, Frame, FrameSource, Received, SourceError, SourceKind};

use super::made::{self, Folder};
use crate::clock::monotonic_ns;
use crate::conformance::{Limits, check};
use crate::dataset::{OpenOptions, Recording};
use crate::{FolderOptions, FolderSource, Pace};

/// Longer than any frame here takes.
const LONG: Duration = Duration::from_secs(20);

/// Fast enough for a test, slow enough that frames are waited for.
const FAST: Pace = Pace::Factor(8.0);

fn recording(folder: &Folder) -> Recording {
    folder.open(&OpenOptions::default()).unwrap().remove(0)
}

fn played(folder: &Folder, options: FolderOptions) -> FolderSource {
    FolderSource::with_options(recording(folder), options).unwrap()
}

fn frame(source: &mut FolderSource) -> Frame {
    match source.next_frame(LONG) {
        Ok(Received::Frame(frame)) => frame,
        other => panic!("{other:?} instead of a frame"),
    }
}

fn refusal(recording: Recording, options: FolderOptions) -> String {
    FolderSource::with_options(recording, options).unwrap_err().to_string()
}

#[test]
fn every_layout_at_every_pace_keeps_the_contract() {
    for (layout, folder) in made::all() {
        for pace in [Pace::Max, FAST, Pace::Realtime] {
            for looped in [false, true] {
                let open = || -> Box<dyn FrameSource> {
                    Box::new(FolderSource::new(recording(&folder), pace, looped).unwrap())
                };
                let limits = Limits { frames: 15, ..Limits::default() };
                let report = check(open, &limits);
                assert_eq!(report.bad, 0, "{layout} {pace:?}");
                assert_eq!(report.ended, !looped, "{layout} {pace:?}");
            }
        }
    }
}

/// Frames 1, 3, 4 and 6 of twelve are unusable, each in its way.
fn damaged() -> Folder {
    let folder = made::images();
    folder.write("1.png", "this is no image");
    let whole = std::fs::read(folder.join("3.png")).unwrap();
    folder.write("3.png", &whole[..whole.len() / 2]);
    std::fs::remove_file(folder.join("4.png")).unwrap();
    std::os::unix::fs::symlink("nowhere", folder.join("4.png")).unwrap();
    folder.colour_of_size("6.png", 6, (9, 6));
    folder
}

#[test]
fn bad_frames_cost_themselves_only() {
    let folder = damaged();
    let mut source = played(&folder, FolderOptions { pace: Pace::Max, ..Default::default() });
    let mut good = Vec::new();
    let mut bad = Vec::new();
    loop {
        match source.next_frame(LONG) {
            Ok(Received::Frame(frame)) => good.push((frame.sequence, frame.pixels.data()[0])),
            Ok(Received::End) => break,
            Err(SourceError::BadFrame { sequence, reason, .. }) => bad.push((sequence, reason)),
            other => panic!("{other:?}"),
        }
    }
    assert_eq!(good, [0, 2, 5, 7, 8, 9, 10, 11].map(|n| (n, n as u8)));
    for ((sequence, reason), (number, part)) in bad.iter().zip([
        (1, "1.png: found bytes 74 68 69 73"),
        (3, "3.png: the image is corrupt"),
        (4, "4.png: No such file"),
        (6, "6.png: found 9x6 pixels, expected 8x6 as in the rest"),
    ]) {
        assert_eq!(*sequence, number);
        assert!(reason.contains(part), "{reason}");
    }
    assert_eq!(bad.len(), 4);
}

#[test]
fn damaged_recordings_keep_the_contract() {
    let folder = damaged();
    for pace in [Pace::Max, FAST] {
        let open = || -> Box<dyn FrameSource> {
            Box::new(FolderSource::new(recording(&folder), pace, false).unwrap())
        };
        let report = check(open, &Limits::default());
        assert!(
            report.bad == 4 || (pace == FAST && report.bad + report.dropped >= 4),
            "{pace:?}: {report:?}"
        );
    }
}

#[test]
fn on_demand_frames_carry_the_recorded_times() {
    let folder = made::tum();
    let mut source = played(&folder, FolderOptions { pace: Pace::Max, ..Default::default() });
    let info = source.info();
    assert_eq!((info.kind, info.length), (SourceKind::OnDemand, Some(5)));
    let times: Vec<u64> = (0..5).map(|_| frame(&mut source).capture_time.ns).collect();
    assert_eq!(times, [5, 45, 85, 125, 165].map(|ms| 1_000_000_000_000 + ms * 1_000_000));
    assert_eq!(source.next_frame(LONG).unwrap(), Received::End);
}

#[test]
fn live_frames_are_stamped_with_the_moment_they_are_due() {
    let folder = made::kitti();
    for (pace, interval_ns) in [(Pace::Factor(4.0), 25_000_000), (Pace::Realtime, 100_000_000)] {
        let mut source = played(&folder, FolderOptions { pace, ..Default::default() });
        let begin_ns = monotonic_ns();
        let mut first_ns = None;
        let mut delivered = 0;
        loop {
            match source.next_frame(LONG).unwrap() {
                Received::Frame(frame) => {
                    let now_ns = monotonic_ns();
                    let due_ns = frame.capture_time.ns;
                    assert_eq!(frame.capture_time.clock, Clock::Monotonic);
                    assert!(begin_ns <= due_ns && due_ns <= now_ns, "no frame comes before it is due");
                    let first_ns = *first_ns.get_or_insert(due_ns - frame.sequence * interval_ns);
                    assert_eq!(due_ns, first_ns + frame.sequence * interval_ns);
                    delivered += 1;
                }
                Received::End => break,
                Received::Timeout => panic!("no frame"),
            }
        }
        assert_eq!(delivered + source.dropped_frames(), 5);
        assert_eq!(source.info().nominal_rate_hz, Some(1e9 / interval_ns as f64));
    }
}

#[test]
fn a_late_consumer_gets_the_newest_frame_and_the_count() {
    let folder = made::images();
    let options = FolderOptions { pace: FAST, looped: true, ..Default::default() };
    let mut source = played(&folder, options);
    // On a busy machine the very first frames may be lost already: all those before this one.
    let first = frame(&mut source).sequence;
    // The consumer is busy until three more frames were lost.
    let begin = Instant::now();
    while source.dropped_frames() < first + 3 {
        assert!(begin.elapsed() < LONG, "nothing was dropped");
        std::thread::yield_now();
    }
    let late = frame(&mut source);
    let dropped = source.dropped_frames();
    assert!(late.sequence >= first + 4, "an old frame, number {}", late.sequence);
    // All but the two delivered ones were dropped; more may have been since.
    assert!(late.sequence <= dropped + 1, "number {} after {dropped} dropped", late.sequence);
    assert_eq!(late.pixels.data()[0], (late.sequence % 12) as u8);
}

#[test]
fn loops_grow_in_number_and_time() {
    let folder = made::kitti();
    for pace in [Pace::Max, Pace::Factor(10.0)] {
        let mut source = played(&folder, FolderOptions { pace, looped: true, ..Default::default() });
        assert_eq!(source.info().length, None);
        let mut last: Option<Frame> = None;
        while last.as_ref().is_none_or(|last| last.sequence < 12) {
            let next = frame(&mut source);
            assert_eq!(next.pixels.data()[0], (next.sequence % 5) as u8);
            if let Some(last) = &last {
                let step = next.sequence - last.sequence;
                let interval_ns = if pace == Pace::Max { 100_000_000 } else { 10_000_000 };
                assert_eq!(next.capture_time.since(last.capture_time), i128::from(step * interval_ns));
                assert!(pace != Pace::Max || step == 1);
            }
            last = Some(next);
        }
    }
}

#[test]
fn a_part_is_played() {
    let folder = made::images();
    let options = FolderOptions { pace: Pace::Max, looped: false, start_at: 3, limit: Some(2) };
    let mut source = played(&folder, options);
    assert_eq!(source.info().length, Some(2));
    assert_eq!([frame(&mut source).sequence, frame(&mut source).sequence], [3, 4]);
    assert_eq!(source.next_frame(LONG).unwrap(), Received::End);
    let mut source = played(&folder, FolderOptions { looped: true, ..options });
    let round: Vec<(u64, u8)> =
        (0..4).map(|_| frame(&mut source)).map(|f| (f.sequence, f.pixels.data()[0])).collect();
    assert_eq!(round, [(3, 3), (4, 4), (5, 3), (6, 4)]);
    let behind: Vec<Option<u64>> =
        [2, 3, 6].map(|number| source.recorded_frame(number).map(|frame| frame.sequence)).into();
    assert_eq!(behind, [None, Some(3), Some(4)]);
    let rest = played(
        &folder,
        FolderOptions { pace: Pace::Max, start_at: 10, limit: Some(99), ..Default::default() },
    );
    assert_eq!(rest.info().length, Some(2));
}

#[test]
fn a_timeout_is_kept_and_a_waiting_source_closes_at_once() {
    let folder = made::kitti();
    // The second frame is due after a hundred seconds.
    let options = FolderOptions { pace: Pace::Factor(0.001), ..Default::default() };
    let mut source = played(&folder, options);
    frame(&mut source);
    let begin = Instant::now();
    let timeout = Duration::from_millis(5);
    assert_eq!(source.next_frame(timeout).unwrap(), Received::Timeout);
    assert!(begin.elapsed() >= timeout && begin.elapsed() < LONG);
    drop(source);
    assert!(begin.elapsed() < LONG, "closing waited for the next frame");
}

#[test]
fn intrinsics_travel_with_the_frames() {
    let folder = made::kitti();
    let mut source = played(&folder, FolderOptions { pace: Pace::Max, ..Default::default() });
    let camera = frame(&mut source).camera.unwrap();
    assert_eq!((camera.focal_px(), source.info().camera), ((10.0, 10.0), Some(camera)));
}

#[test]
fn what_cannot_be_played_is_refused() {
    let folder = made::images();
    for factor in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let options = FolderOptions { pace: Pace::Factor(factor), ..Default::default() };
        let message = refusal(recording(&folder), options);
        assert!(message.contains("expected a positive factor"), "{message}");
    }
    for (start_at, limit) in [(12, None), (0, Some(0)), (usize::MAX, Some(1))] {
        let options = FolderOptions { start_at, limit, ..Default::default() };
        let message = refusal(recording(&folder), options);
        assert!(message.contains("nothing to play") && message.contains("12 frames"), "{message}");
    }
    let mut falling = recording(&folder);
    falling.frames[3].time_ns = 0;
    assert!(refusal(falling, FolderOptions::default()).contains("3.png lies before its predecessor's"));
}
