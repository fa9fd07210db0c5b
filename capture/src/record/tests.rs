use std::fs;
use std::path::Path;
use std::sync::Arc;

use grnet_frame::{Camera, CaptureTime, Distortion, Frame, PixelFormat, Pixels};

use super::*;
use crate::dataset::{self, Layout, OpenOptions};
use crate::decode::decode_file;

fn options() -> RecordOptions {
    RecordOptions {
        format: ImageFormat::Png,
        least_free_bytes: 0,
        realtime_offset_ns: 1_700_000_000_000_000_000,
        camera: None,
        generator: "test 1".into(),
        source: "made".into(),
    }
}

fn frame(sequence: u64, capture_time: CaptureTime) -> Frame {
    let data = (0..24).map(|i| i * 7 + sequence as u8).collect();
    let camera =
        Camera::new((4, 2), (5.25, 5.0), (1.5, 0.5), Distortion::PlumbBob([0.1, 0.0, 1e-3, 0.0, 0.0]));
    let pixels = Arc::new(Pixels::packed(PixelFormat::Rgb8, 4, 2, data).unwrap());
    Frame { pixels, capture_time, sequence, camera: Some(camera.unwrap()) }
}

/// Writes frames at these times of the monotonic clock.
fn record(folder: &Path, times_ns: &[u64]) -> RecordingWriter {
    let mut writer = RecordingWriter::create(folder, options()).unwrap();
    for (sequence, ns) in (10..).zip(times_ns) {
        writer.write(&frame(sequence, CaptureTime::monotonic(*ns))).unwrap();
    }
    writer
}

#[test]
fn what_is_written_opens_as_a_dataset_with_times_camera_and_pixels() {
    let folder = tempfile::tempdir().unwrap();
    let manifest = record(folder.path(), &[5, 1_000_000_007]).finish("stopped", 3).unwrap();
    assert_eq!((manifest.frames, manifest.left_out(), manifest.complete), (2, 3, true));
    for layout in [Layout::Auto, Layout::Tum] {
        let options = OpenOptions { layout, ..OpenOptions::default() };
        let recording = dataset::open_one(folder.path(), &options).unwrap();
        assert_eq!(recording.layout, Layout::Tum);
        assert_eq!(recording.camera, frame(0, CaptureTime::monotonic(0)).camera);
        let times: Vec<u64> = recording.frames.iter().map(|f| f.time_ns).collect();
        assert_eq!(times, [1_700_000_000_000_000_005, 1_700_000_001_000_000_007]);
        for (recorded, sequence) in recording.frames.iter().zip(10..) {
            let wanted = frame(sequence, CaptureTime::monotonic(0)).pixels;
            assert!(decode_file(&recorded.path).unwrap() == *wanted);
        }
    }
    let read: Manifest =
        serde_json::from_str(&fs::read_to_string(folder.path().join("recording.json")).unwrap()).unwrap();
    assert_eq!((read.clock.as_deref(), read.size_px), (Some("realtime"), Some((4, 2))));
    assert_eq!(read, manifest);
    let numbers = fs::read_to_string(folder.path().join("frames.csv")).unwrap();
    assert_eq!(numbers.lines().nth(2), Some("11,1000000007,rgb/1700000001.000000007.png"));
}

#[test]
fn a_recording_without_its_end_is_readable_and_says_so() {
    let folder = tempfile::tempdir().unwrap();
    drop(record(folder.path(), &[1, 2]));
    // What a kill in the middle of an image leaves.
    fs::write(folder.path().join("rgb/.partial"), "half an im").unwrap();
    let recording = dataset::open_one(folder.path(), &OpenOptions::default()).unwrap();
    assert_eq!(recording.frames.len(), 2);
    let manifest = fs::read_to_string(folder.path().join("recording.json")).unwrap();
    assert!(manifest.contains("\"complete\": false"), "{manifest}");
}

#[test]
fn recorded_times_stay_and_times_that_do_not_grow_are_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let mut writer = RecordingWriter::create(folder.path(), options()).unwrap();
    let mut write = |ns| writer.write(&frame(ns, CaptureTime::recorded(ns))).unwrap();
    assert_eq!([write(8), write(8), write(7), write(9)], {
        use Written::{Frame, NotLater};
        [Frame, NotLater, NotLater, Frame]
    });
    assert_eq!((writer.manifest().frames, writer.manifest().left_out_not_later), (2, 2));
    let recording = dataset::open_one(folder.path(), &OpenOptions::default()).unwrap();
    assert_eq!(recording.frames.iter().map(|f| f.time_ns).collect::<Vec<_>>(), [8, 9]);
}

#[test]
fn a_folder_with_anything_in_it_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("thesis.tex"), "years").unwrap();
    let error = RecordingWriter::create(folder.path(), options()).unwrap_err().to_string();
    assert!(error.contains("thesis.tex") && error.contains("empty"), "{error}");
    let below_a_file = folder.path().join("thesis.tex/recording");
    let error = RecordingWriter::create(&below_a_file, options()).unwrap_err().to_string();
    assert!(error.contains("cannot create the folder"), "{error}");
}

#[test]
fn too_little_space_refuses_the_start() {
    let folder = tempfile::tempdir().unwrap();
    let greedy = RecordOptions { least_free_bytes: u64::MAX, ..options() };
    let error = RecordingWriter::create(folder.path(), greedy).unwrap_err();
    assert!(matches!(error, RecordError::Full { .. }) && error.to_string().contains("make room"), "{error}");
}

#[test]
fn a_folder_that_goes_away_is_an_error_with_its_path() {
    let folder = tempfile::tempdir().unwrap();
    let mut writer = record(folder.path(), &[1]);
    fs::remove_dir_all(folder.path().join("rgb")).unwrap();
    let error = writer.write(&frame(1, CaptureTime::monotonic(2))).unwrap_err().to_string();
    assert!(error.contains("cannot write") && error.contains("rgb/1700000000.000000002.png"), "{error}");
    assert_eq!(writer.manifest().frames, 1);
}
