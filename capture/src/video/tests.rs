//! Videos that ffmpeg itself has made, played at every pace.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use grnet_frame::{Frame, PixelFormat, Received, SourceKind};
use tempfile::TempDir;

use super::*;
use crate::conformance::{Limits, check};
use crate::dataset::{self, OpenOptions};
use crate::{FolderOptions, FolderSource};

/// Longer than any frame here takes.
const LONG: Duration = Duration::from_secs(30);

const FRAMES: u64 = 24;

/// Images whose pixels and numbers can be told apart, and videos made from them.
struct Made(TempDir);

impl Made {
    fn new() -> Self {
        let made = Self(tempfile::tempdir().unwrap());
        for number in 0..FRAMES as u32 {
            let pixel =
                |x, y| image::Rgb([(x * 5 + number) as u8, (y * 7) as u8, (x * y + 3 * number) as u8]);
            image::RgbImage::from_fn(48, 32, pixel)
                .save(made.path(&format!("images/{number:03}.png")))
                .unwrap();
        }
        made
    }

    fn path(&self, name: &str) -> PathBuf {
        let path = self.0.path().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        path
    }

    fn ffmpeg(&self, arguments: &[&str]) {
        let output = Command::new("ffmpeg")
            .args(["-nostdin", "-loglevel", "error", "-y"])
            .args(arguments)
            .current_dir(self.0.path())
            .stdin(Stdio::null())
            .output()
            .expect("the tests need ffmpeg: scripts/install-packages test");
        assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    }

    /// The images as a video at 30 frames/s.
    fn video(&self, name: &str, encoding: &[&str]) -> PathBuf {
        let images = ["-framerate", "30", "-i", "images/%03d.png"];
        self.ffmpeg(&[&images, encoding, &[name]].concat());
        self.path(name)
    }

    /// Without loss, every frame by itself, and with times in units of the frame rate.
    fn lossless(&self) -> PathBuf {
        self.video("lossless.avi", &["-c:v", "ffv1", "-level", "3", "-g", "1", "-pix_fmt", "bgr0"])
    }
}

fn at(pace: Pace) -> VideoOptions {
    VideoOptions { pace, ..VideoOptions::default() }
}

fn opened(path: &Path, options: &VideoOptions) -> VideoSource {
    VideoSource::open(path, options).unwrap()
}

fn refusal(path: &Path, options: &VideoOptions) -> String {
    VideoSource::open(path, options).unwrap_err().to_string()
}

/// Everything to the end: the frames, and the reasons of the bad ones.
fn all(source: &mut dyn FrameSource) -> (Vec<Frame>, Vec<(u64, String)>) {
    let (mut good, mut bad) = (Vec::new(), Vec::new());
    loop {
        match source.next_frame(LONG) {
            Ok(Received::Frame(frame)) => good.push(frame),
            Ok(Received::End) => return (good, bad),
            Err(SourceError::BadFrame { sequence, reason, .. }) => bad.push((sequence, reason)),
            other => panic!("{other:?}"),
        }
    }
}

#[test]
fn a_lossless_video_gives_the_frames_and_times_of_its_images() {
    let made = Made::new();
    let video = made.lossless();
    for (start_at, limit, looped) in [(0, None, false), (5, Some(9), false), (20, None, true)] {
        let options = VideoOptions { start_at, limit, looped, ..at(Pace::Max) };
        let mut source = opened(&video, &options);
        let info = source.info();
        assert_eq!((info.kind, info.nominal_rate_hz, info.length), (SourceKind::OnDemand, Some(30.0), None));
        assert_eq!(source.size_px(), (48, 32));
        let read = OpenOptions { rate_hz: Some(30.0), ..OpenOptions::default() };
        let recording = dataset::open_one(&made.path("images"), &read).unwrap();
        let (start_at, limit) = (start_at as usize, limit.map(|limit| limit as usize));
        let options = FolderOptions { pace: Pace::Max, looped, start_at, limit };
        let mut folder = FolderSource::with_options(recording, options).unwrap();
        for _ in 0..if looped { 11 } else { u64::MAX } {
            let (expected, found) = (folder.next_frame(LONG).unwrap(), source.next_frame(LONG).unwrap());
            assert!(found == expected, "{found:?} instead of {expected:?}");
            if expected == Received::End {
                break;
            }
        }
    }
}

#[test]
fn every_pace_keeps_the_contract() {
    let made = Made::new();
    let video = made.lossless();
    for pace in [Pace::Max, Pace::Factor(4.0), Pace::Realtime] {
        for looped in [false, true] {
            let options = VideoOptions { looped, ..at(pace) };
            let open = || -> Box<dyn FrameSource> { Box::new(opened(&video, &options)) };
            let report = check(open, &Limits { frames: 30, ..Limits::default() });
            assert_eq!((report.bad, report.ended), (0, !looped), "{pace:?}");
            if !looped {
                assert_eq!(report.frames + report.dropped, FRAMES, "{pace:?}");
            }
        }
    }
}

#[test]
fn a_variable_rate_is_played_as_it_was_filmed() {
    let made = Made::new();
    made.lossless();
    // Every frame at 4 ms times its number squared.
    let slower = ["-i", "lossless.avi", "-vf", "settb=1/1000,setpts=4*N*N", "-fps_mode", "passthrough"];
    made.ffmpeg(
        &[&slower[..], &["-enc_time_base", "1/1000", "-c:v", "ffv1", "-pix_fmt", "bgr0", "v.mkv"]].concat(),
    );
    let (frames, bad) = all(&mut opened(&made.path("v.mkv"), &at(Pace::Max)));
    let times: Vec<u64> = frames.iter().map(|frame| frame.capture_time.ns).collect();
    assert_eq!(times, (0..FRAMES).map(|n| 4_000_000 * n * n).collect::<Vec<_>>());
    assert!(bad.is_empty());
    let mut live = opened(&made.path("v.mkv"), &at(Pace::Factor(8.0)));
    let (frames, _) = all(&mut live);
    let start = frames[0].capture_time.ns - 500_000 * frames[0].sequence.pow(2);
    for frame in &frames {
        assert_eq!(frame.capture_time.ns, start + 500_000 * frame.sequence.pow(2));
    }
    assert_eq!(frames.len() as u64 + live.dropped_frames(), FRAMES);
    let regular = VideoOptions { rate_hz: Some(50.0), ..at(Pace::Max) };
    let (frames, _) = all(&mut opened(&made.path("v.mkv"), &regular));
    assert_eq!(frames[7].capture_time.ns, 140_000_000);
}

#[test]
fn a_slow_consumer_holds_ffmpeg_up_or_gets_the_newest_frame() {
    let made = Made::new();
    let video = made.lossless();
    let options = VideoOptions { looped: true, ..at(Pace::Factor(8.0)) };
    let mut source = opened(&video, &options);
    let Received::Frame(first) = source.next_frame(LONG).unwrap() else { panic!("no frame") };
    let begin = Instant::now();
    while source.dropped_frames() < first.sequence + 3 {
        assert!(begin.elapsed() < LONG, "nothing was dropped");
        std::thread::yield_now();
    }
    let Received::Frame(late) = source.next_frame(LONG).unwrap() else { panic!("no frame") };
    assert!(late.sequence >= first.sequence + 4);
}

#[test]
fn grey_stays_grey_and_a_turned_video_is_upright() {
    let made = Made::new();
    let grey = made.video("grey.avi", &["-c:v", "ffv1", "-pix_fmt", "gray"]);
    let (frames, _) = all(&mut opened(&grey, &at(Pace::Max)));
    assert_eq!((frames[0].pixels.format(), frames.len() as u64), (PixelFormat::Gray8, FRAMES));

    let mp4 = made.video("flat.mp4", &["-c:v", "mpeg4", "-q:v", "2", "-pix_fmt", "yuv420p"]);
    let mut bytes = std::fs::read(&mp4).unwrap();
    // The matrix in the track's header, from one to a quarter turn: a, b, u, c, d, v, x, y, w.
    let header = bytes.windows(4).position(|name| name == b"tkhd").unwrap();
    let one: i32 = 0x10000;
    let matrix = [0, one, 0, -one, 0, 0, 32 * one, 0, 0x4000_0000].map(i32::to_be_bytes).concat();
    bytes[header + 44..][..36].copy_from_slice(&matrix);
    let turned = made.path("turned.mp4");
    std::fs::write(&turned, bytes).unwrap();
    let (flat, upright) = (opened(&mp4, &at(Pace::Max)), opened(&turned, &at(Pace::Max)));
    assert_eq!((flat.size_px(), upright.size_px()), ((48, 32), (32, 48)));
    assert!(upright.notes().iter().any(|note| note.contains("rotation of -90")), "{:?}", upright.notes());
    let ((mut flat, mut upright), mut worst) = ((flat, upright), 0);
    let (flat, upright) = (all(&mut flat).0, all(&mut upright).0);
    for x in 0..48 {
        for y in 0..32 {
            let stored = &flat[3].pixels.row(y)[3 * x..][..3];
            let turned = &upright[3].pixels.row(x)[3 * (31 - y)..][..3];
            worst = stored.iter().zip(turned).map(|(a, b)| a.abs_diff(*b)).max().unwrap().max(worst);
        }
    }
    // Half-resolution chroma is interpolated along other lines.
    assert!(worst < 64, "{worst}");
}

#[test]
fn damage_costs_frames_and_a_missing_tail_is_told() {
    let made = Made::new();
    let video = made.lossless();
    made.ffmpeg(&["-i", "lossless.avi", "-c", "copy", "whole.mkv"]);
    let whole = std::fs::read(made.path("whole.mkv")).unwrap();
    let cut = made.path("cut.mkv");
    std::fs::write(&cut, &whole[..whole.len() * 6 / 10]).unwrap();
    let (good, bad) = all(&mut opened(&cut, &at(Pace::Max)));
    assert!(good.len() > 8 && good.len() < 20, "{}", good.len());
    assert!(good.iter().enumerate().all(|(index, frame)| frame.sequence == index as u64));
    let (last, reason) = bad.last().expect("the missing tail is told");
    assert!(*last >= good.len() as u64 && reason.contains("ends early"), "{bad:?}");

    let mut bytes = std::fs::read(&video).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle..middle + 40].iter_mut().for_each(|byte| *byte ^= 0x5a);
    let damaged = made.path("damaged.avi");
    std::fs::write(&damaged, bytes).unwrap();
    let open = || -> Box<dyn FrameSource> { Box::new(opened(&damaged, &at(Pace::Max))) };
    let report = check(open, &Limits::default());
    assert!(report.bad >= 1 && report.frames >= FRAMES - 4, "{report:?}");
    let (good, _) = all(&mut opened(&damaged, &at(Pace::Max)));
    let whole = all(&mut opened(&video, &at(Pace::Max))).0;
    for frame in &good {
        let same = whole.iter().find(|whole| whole.capture_time == frame.capture_time).unwrap();
        assert!(same.pixels == frame.pixels, "frame {} was made up", frame.sequence);
    }
}

#[test]
fn what_cannot_be_played_is_refused_in_words() {
    let made = Made::new();
    let video = made.lossless();
    let plain = at(Pace::Max);
    let missing = VideoOptions { ffmpeg: "/nowhere/ffmpeg".into(), ..plain.clone() };
    let text = made.path("text.mp4");
    std::fs::write(&text, "no video at all\n").unwrap();
    made.ffmpeg(&["-f", "lavfi", "-i", "sine=duration=0.1", "sound.mp4"]);
    let whole = std::fs::read(made.video("whole.mp4", &["-c:v", "mpeg4"])).unwrap();
    let cut = made.path("cut.mp4");
    std::fs::write(&cut, &whole[..whole.len() / 2]).unwrap();
    for (path, options, part) in [
        (&video, &missing, "/nowhere/ffmpeg is not there: install it"),
        (&made.path("none.avi"), &plain, "cannot be read: No such file"),
        (&made.path("images"), &plain, "it is a folder"),
        (&PathBuf::from("/dev/null"), &plain, "no regular file"),
        (&text, &plain, "Invalid data found"),
        (&made.path("sound.mp4"), &plain, "matches no streams"),
        (&cut, &plain, "moov atom not found"),
        (&video, &VideoOptions { start_at: FRAMES, ..plain.clone() }, "it has no frame 24"),
        (&video, &VideoOptions { limit: Some(0), ..plain.clone() }, "limit is 0"),
        (&video, &at(Pace::Factor(-1.0)), "positive factor"),
        (&video, &VideoOptions { rate_hz: Some(f64::NAN), ..plain.clone() }, "positive number"),
    ] {
        let message = refusal(path, options);
        assert!(message.contains(part), "{message}");
    }
}

#[test]
fn a_name_is_never_an_option_a_pattern_or_an_address() {
    let made = Made::new();
    let video = std::fs::read(made.lossless()).unwrap();
    for name in ["-version", "%03d.png", "http:x", "a,b;c[d]=e'f\".avi", "concat:a|b", "\u{e9}\n.avi"] {
        std::fs::write(made.path(name), &video).unwrap();
        let (frames, bad) = all(&mut opened(&made.path(name), &at(Pace::Max)));
        assert_eq!((frames.len() as u64, bad.len()), (FRAMES, 0), "{name:?}");
    }
    // Lists of other files and of addresses are not followed.
    let address = "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nhttp://127.0.0.1:9/a.ts\n".to_owned();
    let file = format!("ffconcat version 1.0\nfile '{}'\n", made.path("lossless.avi").display());
    for text in [address, file] {
        let list = made.path("list");
        std::fs::write(&list, text).unwrap();
        let message = refusal(&list, &at(Pace::Max));
        assert!(message.contains("cannot read it as a video: its format is none of the known"), "{message}");
    }
}

#[test]
fn ffmpeg_ends_with_the_source() {
    let made = Made::new();
    let video = made.lossless();
    // Its standard input is the file.
    let is_running = || {
        std::fs::read_dir("/proc").unwrap().map_while(Result::ok).any(|entry| {
            let program = std::fs::read_link(entry.path().join("exe")).unwrap_or_default();
            program.ends_with("ffmpeg")
                && std::fs::read_link(entry.path().join("fd/0")).is_ok_and(|input| input == video)
        })
    };
    for pace in [Pace::Max, Pace::Realtime, Pace::Factor(0.001)] {
        let mut source = opened(&video, &VideoOptions { looped: true, ..at(pace) });
        assert!(is_running());
        assert!(matches!(source.next_frame(LONG), Ok(Received::Frame(_))));
        drop(source);
        assert!(!is_running(), "{pace:?}");
    }
    drop(opened(&video, &at(Pace::Max)));
    assert!(!is_running());
}
