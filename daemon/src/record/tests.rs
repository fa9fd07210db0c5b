use grnet_frame::{CaptureTime, PixelFormat, Pixels};
use grnet_proto::{Access, BootId, CameraName, Recording};

use super::*;
use crate::scenes::ModelIdentity;

fn identity() -> Identity {
    Identity {
        boot_id: BootId::NONE,
        camera: CameraName::default(),
        access: Access::USER,
        source: "script".into(),
    }
}

fn state() -> Arc<State> {
    let model = ModelIdentity { model_hash: [0; 32], name: "m".into(), trained: true, scene: None };
    Arc::new(State::new(identity(), model))
}

fn frame(sequence: u64) -> Frame {
    let pixels = Pixels::packed(PixelFormat::Gray8, 2, 1, vec![sequence as u8; 2]).unwrap();
    let capture_time = CaptureTime::monotonic(1000 + sequence);
    Frame { pixels: pixels.into(), capture_time, sequence, camera: None }
}

/// A running record thread.
struct Rig {
    folder: tempfile::TempDir,
    tap: Tap,
    ask: Sender<Asked>,
    state: Arc<State>,
    stop: Stop,
    thread: std::thread::JoinHandle<Result<(), Failure>>,
}

fn rig(kind: SourceKind, change: impl FnOnce(&mut GrnetdConfig)) -> Rig {
    let folder = tempfile::tempdir().unwrap();
    let mut config = GrnetdConfig::default();
    config.record.folder = folder.path().to_owned();
    config.record.least_free_bytes = 0;
    change(&mut config);
    let (stop, state) = (Stop::default(), state());
    let (tap, tapped) = tap(kind, 4, false, stop.clone());
    let (ask, asked) = bounded(1);
    let record = Record {
        recorder: Recorder::new(&config, &identity()),
        first: None,
        tapped,
        asked,
        state: Arc::clone(&state),
        stop: stop.clone(),
        activity: Activity::default(),
    };
    let thread = std::thread::spawn(move || run(record));
    Rig { folder, tap, ask, state, stop, thread }
}

impl Rig {
    fn ask(&self, ask: Ask) -> Answer {
        let (reply, answer) = bounded(1);
        self.ask.send((ask, reply)).unwrap();
        answer.recv().unwrap()
    }

    fn is_recording(&self) -> bool {
        self.state.status(Now::read()).recording == Recording::ON
    }

    fn lines(&self, recording: &str) -> usize {
        let list = std::fs::read_to_string(self.folder.path().join(recording).join("rgb.txt")).unwrap();
        list.lines().filter(|line| !line.starts_with('#')).count()
    }
}

#[test]
fn recordings_begin_and_end_on_request_and_hold_every_frame_between() {
    let rig = rig(SourceKind::OnDemand, |_| ());
    rig.tap.offer(&frame(0));
    assert_eq!(rig.ask(Ask::Stop).0, Outcome::REFUSED);
    let folder = rig.folder.path().join("a");
    let (outcome, text) = rig.ask(Ask::Start(Some(folder.clone())));
    assert!(outcome == Outcome::DONE && text.contains("/a") && rig.is_recording(), "{text}");
    for sequence in 1..=20 {
        rig.tap.offer(&frame(sequence));
    }
    let (outcome, text) = rig.ask(Ask::Start(None));
    assert!(outcome == Outcome::REFUSED && text.contains("stop it first"), "{text}");
    let (outcome, text) = rig.ask(Ask::Stop);
    assert!(outcome == Outcome::DONE && text.starts_with("20 frames recorded in"), "{text}");
    assert!(!rig.is_recording());
    rig.tap.offer(&frame(21));

    // The same folder is not overwritten, and the failure changes nothing.
    let (outcome, text) = rig.ask(Ask::Start(Some(folder)));
    assert!(outcome == Outcome::FAILED && text.contains("empty"), "{text}");
    assert!(!rig.is_recording());
    let (outcome, text) = rig.ask(Ask::Start(None));
    assert!(outcome == Outcome::DONE && text.contains("front-20") && text.ends_with('Z'), "{text}");
    assert_eq!(rig.lines("a"), 20);
    assert_eq!(rig.state.counters.recorded.load(Relaxed), 20);
}

#[test]
fn the_stop_ends_a_recording_properly() {
    let rig = rig(SourceKind::OnDemand, |_| ());
    rig.ask(Ask::Start(Some(rig.folder.path().join("a"))));
    for sequence in 0..3 {
        rig.tap.offer(&frame(sequence));
    }
    rig.tap.drain();
    assert_eq!(rig.lines("a"), 3);
    rig.stop.stop();
    let Rig { folder, thread, .. } = rig;
    thread.join().unwrap().unwrap();
    let json = std::fs::read_to_string(folder.path().join("a/recording.json")).unwrap();
    assert!(json.contains("\"complete\": true") && json.contains("the daemon ended"), "{json}");
}

#[test]
fn a_live_source_never_waits_and_what_finds_the_queue_full_is_counted() {
    // Nobody takes anything out of the queue.
    let (tap, tapped) = tap(SourceKind::Live, 2, true, Stop::default());
    for sequence in 0..5 {
        tap.offer(&frame(sequence));
    }
    assert_eq!((tapped.items.len(), tapped.shared.queue_full.load(Relaxed)), (2, 3));

    let folder = tempfile::tempdir().unwrap();
    let mut config = GrnetdConfig::default();
    config.record.least_free_bytes = 0;
    let recorder = Recorder::new(&config, &identity());
    let writer = recorder.begin(folder.path()).unwrap();
    let (full, bad) = (Repeats::default(), Repeats::default());
    let mut thread = Thread { recorder, tapped, state: state(), writer: Some(writer), full, bad, told: 0 };
    let text = thread.end("test", None).unwrap();
    assert!(text.contains("2 frames recorded") && text.contains("3 left out (3 found"), "{text}");
    assert_eq!(thread.state.counters.unrecorded.load(Relaxed), 3);
    assert!(thread.state.summary().contains("2 frames recorded, 3 left out of the recording"));
}

#[test]
fn a_disk_that_fails_ends_the_recording_with_an_error_and_nothing_else() {
    let rig = rig(SourceKind::OnDemand, |_| ());
    let folder = rig.folder.path().join("a");
    rig.ask(Ask::Start(Some(folder.clone())));
    rig.tap.offer(&frame(1));
    rig.tap.drain();
    std::fs::remove_dir_all(folder.join("rgb")).unwrap();
    rig.tap.offer(&frame(2));
    rig.tap.drain();
    assert!(!rig.is_recording());
    let status = rig.state.status(Now::read());
    assert!(status.last_error.to_string().contains("the recording has ended"), "{}", status.last_error);
    assert_eq!(rig.ask(Ask::Stop).0, Outcome::REFUSED);
    assert_eq!(rig.ask(Ask::Start(Some(rig.folder.path().join("b")))).0, Outcome::DONE);
    assert!(rig.is_recording());
}

#[test]
fn too_little_space_is_refused_with_the_numbers() {
    let rig = rig(SourceKind::Live, |config| config.record.least_free_bytes = u64::MAX);
    let (outcome, text) = rig.ask(Ask::Start(None));
    assert!(outcome == Outcome::FAILED && text.contains("MiB free"), "{text}");
}

#[test]
fn folders_are_named_by_the_calendar() {
    assert_eq!(utc(0), "19700101T000000Z");
    assert_eq!(utc(951_782_399), "20000228T235959Z");
    assert_eq!(utc(951_782_400), "20000229T000000Z");
    assert_eq!(utc(1_764_103_481), "20251125T204441Z");
}
