//! What ffmpeg tells on its standard error, line by line.

use std::collections::VecDeque;

use grnet_frame::PixelFormat;

use crate::decode::MAX_SIDE_PX;

/// Longest text that is kept of a line.
const MOST_CHARS: usize = 200;

/// Something that happens between two frames.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Event {
    /// The pixels of this frame come next.
    Frame(Stamp),
    /// A frame could not be decoded.
    Lost(String),
    /// The next frame is damaged.
    Spoilt(String),
    /// Something else is wrong, maybe without consequence.
    Complaint(String),
}

/// What is told about a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Stamp {
    /// Since the start of the file; `None` where the file does not say.
    pub time_ns: Option<u64>,
    pub size_px: (u32, u32),
    pub format: PixelFormat,
}

impl Stamp {
    /// Bytes of its pixels.
    pub fn length_bytes(&self) -> usize {
        self.format.row_bytes(self.size_px.0).unwrap_or(0) * self.size_px.1 as usize
    }
}

/// What was told about the file, and the last that went wrong.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Summary {
    /// Length, codec and rotation, each a line of ffmpeg.
    pub about: Vec<String>,
    pub frame_rate_hz: Option<f64>,
    errors: VecDeque<String>,
}

impl Summary {
    /// The last lines about an error: ffmpeg says first what is wrong, then what it could not do.
    pub fn last_error(&self) -> Option<String> {
        (!self.errors.is_empty())
            .then(|| self.errors.iter().map(String::as_str).collect::<Vec<_>>().join("; "))
    }

    fn error(&mut self, text: String) {
        if self.errors.back() == Some(&text) {
            return;
        }
        if self.errors.len() == 3 {
            self.errors.pop_front();
        }
        self.errors.push_back(text);
    }
}

/// Remembers the unit of times.
#[derive(Debug, Default)]
pub(super) struct Parser {
    /// Seconds as a fraction.
    time_base: Option<(u64, u64)>,
    has_frames: bool,
}

impl Parser {
    /// Takes a line without its end.
    pub fn line(&mut self, line: &str, summary: &mut Summary) -> Option<Event> {
        // A text inside the file is printed behind spaces and cannot look like this.
        if line.starts_with("[Parsed_showinfo_") {
            return self.showinfo(line, summary);
        }
        let (level, text) = leveled(line)?;
        let said = || readable(text);
        match level {
            "info" if !self.has_frames => {
                let text = text.trim();
                let is_about = text.starts_with("Duration: ")
                    || (text.starts_with("Stream #0:") && text.contains(": Video: "))
                    || text.starts_with("displaymatrix: rotation of");
                // The output is described in the same words after the first frame.
                if is_about && summary.about.len() < 8 {
                    summary.about.push(readable(text));
                }
                None
            }
            "warning" if text.contains("corrupt decoded frame in stream") => Some(Event::Spoilt(said())),
            "warning" if text.contains("dropping it") => Some(Event::Lost(said())),
            "error" | "fatal" | "panic" => {
                summary.error(said());
                // While it is opened, ffmpeg tries things that need not succeed.
                if !self.has_frames {
                    return None;
                }
                let is_lost =
                    ["Error while decoding", "Error submitting packet to decoder", "Decoding error"]
                        .iter()
                        .any(|start| text.contains(start));
                // Of the frame that is being decoded; codecs with checksums give frames in the order of the file.
                let is_spoilt = text.contains("CRC mismatch");
                Some(match (is_lost, is_spoilt) {
                    (true, _) => Event::Lost(said()),
                    (false, true) => Event::Spoilt(said()),
                    (false, false) => Event::Complaint(said()),
                })
            }
            _ => None,
        }
    }

    fn showinfo(&mut self, line: &str, summary: &mut Summary) -> Option<Event> {
        if line.contains(" config in ") {
            self.time_base = value(line, "time_base:").and_then(|text| fraction(text.trim_end_matches(',')));
            let rate = value(line, "frame_rate:").and_then(fraction);
            summary.frame_rate_hz = rate.map(|(up, down)| up as f64 / down as f64);
            return None;
        }
        let size = value(line, " s:")?;
        let (width, height) = size.split_once('x')?;
        let size_px: (u32, u32) = (width.parse().ok()?, height.parse().ok()?);
        let is_size = |side: u32| (1..=MAX_SIDE_PX).contains(&side);
        if !is_size(size_px.0) || !is_size(size_px.1) {
            return None;
        }
        let format = match value(line, " fmt:")? {
            "gray" => PixelFormat::Gray8,
            "rgb24" => PixelFormat::Rgb8,
            _ => return None,
        };
        let ticks = value(line, " pts:").and_then(|text| text.parse::<i64>().ok());
        let time_ns = ticks.zip(self.time_base).map(|(ticks, base)| nanoseconds(ticks, base));
        self.has_frames = true;
        Some(Event::Frame(Stamp { time_ns, size_px, format }))
    }
}

/// `[decoder @ 0x...] [level] text` or `[level] text`.
fn leveled(line: &str) -> Option<(&str, &str)> {
    let mut rest = line;
    while let Some(inner) = rest.strip_prefix('[') {
        let (tag, after) = inner.split_once(']')?;
        rest = after.strip_prefix(' ').unwrap_or(after);
        if matches!(tag, "info" | "warning" | "error" | "fatal" | "panic" | "verbose" | "debug") {
            return Some((tag, rest));
        }
    }
    None
}

/// The word behind `key`, before which there may be spaces.
fn value<'a>(line: &'a str, key: &str) -> Option<&'a str> {
    line.split_once(key)?.1.split_whitespace().next()
}

fn fraction(text: &str) -> Option<(u64, u64)> {
    let (up, down) = text.split_once('/')?;
    let (up, down) = (up.parse().ok()?, down.parse().ok()?);
    (up > 0 && down > 0).then_some((up, down))
}

/// Times before the start of the file become its start.
fn nanoseconds(ticks: i64, (up, down): (u64, u64)) -> u64 {
    let scaled =
        u128::from(ticks.max(0).unsigned_abs()).saturating_mul(u128::from(up)).saturating_mul(1_000_000_000);
    let down = u128::from(down);
    u64::try_from(scaled.saturating_add(down / 2) / down).unwrap_or(u64::MAX)
}

/// Text from the file or about it, fit for a log.
fn readable(text: &str) -> String {
    if text.contains("Format not on whitelist") {
        return "its format is none of the known kinds of video files".into();
    }
    text.replace("file:/dev/stdin: ", "")
        .trim()
        .chars()
        .map(|c| if c.is_control() { ' ' } else { c })
        .take(MOST_CHARS)
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const CONFIG: &str =
        "[Parsed_showinfo_3 @ 0x55] [info] config in time_base: 1001/30000, frame_rate: 30000/1001";

    fn events(lines: &[&str]) -> (Vec<Event>, Summary) {
        let (mut parser, mut summary) = (Parser::default(), Summary::default());
        let events = lines.iter().filter_map(|line| parser.line(line, &mut summary)).collect();
        (events, summary)
    }

    #[test]
    fn times_are_exact_in_the_units_of_the_file() {
        let (found, summary) = events(&[
            "[info]   Duration: 00:00:00.67, start: 0.000000, bitrate: 415 kb/s",
            "[info]   Stream #0:0: Video: ffv1 (FFV1 / 0x31564646), bgr0, 64x48, 30 fps",
            "[info]       displaymatrix: rotation of -90.00 degrees",
            "[info]     title           : [Parsed_showinfo_3 @ 0x1] [info] n: 0 pts: 9 fmt:rgb24 s:6x8 ",
            CONFIG,
            "[Parsed_showinfo_3 @ 0x55] [info] n:   0 pts:      3 pts_time:0.1001 pos: 8814 fmt:rgb24 sar:1/1 s:64x48 i:P ",
            "[Parsed_showinfo_3 @ 0x55] [info] color_range:pc color_space:gbr",
            "[Parsed_showinfo_3 @ 0x55] [info] n:   1 pts:NOPTS pts_time:NOPTS duration: 1 fmt:gray cl:left sar:1/1 s:64x48 i:P ",
            "[Parsed_showinfo_3 @ 0x55] [info] n:   2 pts:     -7 pts_time:-0.2 fmt:gray sar:1/1 s:64x48 i:P ",
        ]);
        let size_px = (64, 48);
        let stamp = |time_ns, format| Event::Frame(Stamp { time_ns, size_px, format });
        let (rgb, grey) = (PixelFormat::Rgb8, PixelFormat::Gray8);
        assert_eq!(found, [stamp(Some(100_100_000), rgb), stamp(None, grey), stamp(Some(0), grey)]);
        assert_eq!(summary.about.len(), 3);
        assert!((summary.frame_rate_hz.unwrap() - 29.97).abs() < 1e-3);
    }

    #[test]
    fn what_went_wrong_is_told_apart() {
        let frame = "[Parsed_showinfo_3 @ 0x55] [info] n: 0 pts: 0 pts_time:0 fmt:rgb24 sar:1/1 s:6x8 i:P ";
        let (found, summary) = events(&[
            "[nut @ 0x56] [error] read_timestamp failed.",
            frame,
            "[h264 @ 0x55] [error] mmco: unref short failure",
            "[error] Error while decoding stream #0:0: Invalid data found when processing input",
            "[vist#0:0/h264 @ 0x1] [dec:h264 @ 0x2] [error] Error submitting packet to decoder: Invalid data",
            "[avi @ 0x56] [warning] Packet corrupt (stream = 0, dts = 10), dropping it.",
            "[warning] file:a.mp4: corrupt decoded frame in stream 0",
            "[ffv1 @ 0x56] [error] slice CRC mismatch B6836FFE!at 0.266667 seconds",
            "[warning] something else",
        ]);
        let kinds: Vec<&str> = found
            .iter()
            .map(|event| match event {
                Event::Frame(_) => "frame",
                Event::Lost(_) => "lost",
                Event::Spoilt(_) => "spoilt",
                Event::Complaint(_) => "complaint",
            })
            .collect();
        assert_eq!(kinds, ["frame", "complaint", "lost", "lost", "lost", "spoilt", "spoilt"]);
        assert!(summary.last_error().unwrap().ends_with("CRC mismatch B6836FFE!at 0.266667 seconds"));
    }

    proptest! {
        #[test]
        fn any_line_is_survived(text in "\\[Parsed_showinfo_(\\PC| pts:| s:|x|/){0,80}|\\PC{0,80}", ticks: i64, up: u64) {
            let (mut parser, mut summary) = (Parser::default(), Summary::default());
            parser.line(&format!("[Parsed_showinfo_0 @ 0] config in time_base: {up}/3, x"), &mut summary);
            parser.line(&text, &mut summary);
            let line = format!("[Parsed_showinfo_0 @ 0] n: 0 pts: {ticks} fmt:gray s:6x8");
            prop_assert!(matches!(parser.line(&line, &mut summary), Some(Event::Frame(_))));
        }
    }
}
