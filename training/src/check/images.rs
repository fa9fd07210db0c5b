//! Whether every image can be read, and is worth reading.

use std::hash::{DefaultHasher, Hash as _, Hasher as _};

use grnet_capture::dataset::Recording;
use grnet_capture::decode::decode_file;
use grnet_frame::{PixelFormat, Pixels};
use grnet_geometry::statistics::median;
use image::GrayImage;
use rayon::prelude::*;

use super::finding::{Finding, Severity, by_share};

/// A frame is blurred when it has less than this share of the detail of its neighbours, or ...
const BLURRED_NEAR: f64 = 0.35;
/// ... of the whole recording.
const BLURRED_ALL: f64 = 0.04;
/// Neighbours on either side.
const NEIGHBOURS: usize = 10;

/// Mean grey values outside of which a frame is too dark or too bright.
const DARK: f64 = 20.0;
const BRIGHT: f64 = 235.0;

/// What one image looks like.
#[derive(Debug, Clone, PartialEq)]
pub struct Look {
    /// Width and height in pixels.
    pub size_px: (u32, u32),
    /// Variance of the Laplacian of the grey image at half size.
    pub detail: f64,
    /// Mean grey value.
    pub brightness: f64,
    hash: u64,
}

/// Looks at every image, or says why it cannot be read.
pub fn look(recording: &Recording, progress: &(dyn Fn() + Sync)) -> Vec<Result<Look, String>> {
    let look = |frame: &grnet_capture::dataset::RecordedFrame| {
        progress();
        let pixels = decode_file(&frame.path).map_err(|error| chain(&error))?;
        let mut hasher = DefaultHasher::new();
        pixels.data().hash(&mut hasher);
        let grey = grey(&pixels);
        let brightness = grey.as_raw().iter().map(|v| f64::from(*v)).sum::<f64>() / grey.len() as f64;
        let size_px = (pixels.width_px(), pixels.height_px());
        Ok(Look { size_px, detail: detail(&grey), brightness, hash: hasher.finish() })
    };
    recording.frames.par_iter().map(look).collect()
}

/// What is wrong with them.
pub fn check(recording: &Recording, looks: &[Result<Look, String>]) -> Vec<Finding> {
    let frames = &recording.frames;
    let all = frames.len();
    let number = |index: &usize| frames[*index].sequence;
    let chosen = |wrong: &dyn Fn(usize, &Look) -> bool| -> Vec<u64> {
        let good = looks.iter().enumerate().filter_map(|(index, look)| Some((index, look.as_ref().ok()?)));
        good.filter(|(index, look)| wrong(*index, look)).map(|(index, _)| number(&index)).collect()
    };
    let mut findings = Vec::new();
    let mut add = |frames: Vec<u64>, severity, kind, found: String, advice| {
        if !frames.is_empty() {
            let found = found.replace("{}", &frames.len().to_string());
            findings.push(Finding::new(severity, kind, found, advice).on(frames));
        }
    };

    let unreadable: Vec<usize> = (0..all).filter(|index| looks[*index].is_err()).collect();
    if let Some(first) = unreadable.first() {
        let why = looks[*first].as_ref().err().cloned().unwrap_or_default();
        let found =
            format!("{{}} images cannot be read; the first: {}: {why}", frames[*first].path.display());
        let advice = "delete them together with their lines in lists and poses, or copy them again";
        add(unreadable.iter().map(number).collect(), Severity::Error, "unreadable-image", found, advice);
    }
    let sizes: Vec<(u32, u32)> = looks.iter().flatten().map(|look| look.size_px).collect();
    let Some(size_px) = most_frequent(&sizes) else { return findings };
    let other = chosen(&|_, look| look.size_px != size_px);
    let found = format!("{{}} images are not {}x{} as most are", size_px.0, size_px.1);
    add(
        other,
        Severity::Error,
        "image-size",
        found,
        "intrinsics hold for one size: give each size a recording of its own",
    );

    let same = |a: usize, b: &Look| a > 0 && looks[a - 1].as_ref().is_ok_and(|before| before.hash == b.hash);
    let repeated = chosen(&same);
    let severity = by_share(repeated.len(), all, 0.2);
    let found = "{} images equal the one before, pixel by pixel".to_owned();
    add(
        repeated,
        severity,
        "repeated-image",
        found,
        "a camera that repeats frames while it moves teaches standstill",
    );

    let details: Vec<Option<f64>> = looks.iter().map(|look| look.as_ref().ok().map(|l| l.detail)).collect();
    let known: Vec<f64> = details.iter().flatten().copied().collect();
    let middle = median(&known).unwrap_or_default();
    let near = |index: usize| {
        let range = index.saturating_sub(NEIGHBOURS)..(index + NEIGHBOURS + 1).min(all);
        median(&details[range].iter().flatten().copied().collect::<Vec<f64>>()).unwrap_or_default()
    };
    let is_blurred = |index: usize, look: &Look| {
        look.detail < BLURRED_NEAR * near(index) || look.detail < BLURRED_ALL * middle
    };
    let blurred = chosen(&is_blurred);
    let severity = if blurred.len() * 50 > all { Severity::Warning } else { Severity::Note };
    let found = format!(
        "{{}} images are blurred: the variance of their Laplacian is below {:.0} % of their neighbours' or {:.0} % of \
         the recording's ({middle:.1})",
        100.0 * BLURRED_NEAR,
        100.0 * BLURRED_ALL
    );
    add(blurred, severity, "blur", found, "shorten the exposure or move more slowly");

    for (is_dark, name, limit, advice) in [
        (true, "too-dark", DARK, "lengthen the exposure or light the place"),
        (false, "too-bright", BRIGHT, "shorten the exposure"),
    ] {
        let wrong =
            chosen(&|_, look| if is_dark { look.brightness < limit } else { look.brightness > limit });
        let severity = by_share(wrong.len(), all, 0.2);
        let found = format!(
            "{{}} images have a mean grey value {} {limit:.0}",
            if is_dark { "below" } else { "above" }
        );
        add(wrong, severity, name, found, advice);
    }
    findings
}

/// Grey values as television weighs colours (BT.601).
pub(super) fn grey(pixels: &Pixels) -> GrayImage {
    let (width, height) = (pixels.width_px(), pixels.height_px());
    let mut data = Vec::with_capacity(width as usize * height as usize);
    for y in 0..height as usize {
        let row = pixels.row(y);
        if pixels.format() == PixelFormat::Rgb8 {
            let luma = |c: &[u8]| (u32::from(c[0]) * 77 + u32::from(c[1]) * 150 + u32::from(c[2]) * 29) >> 8;
            data.extend(row.chunks_exact(3).map(|c| luma(c) as u8));
        } else {
            data.extend_from_slice(row);
        }
    }
    // As many bytes as pixels.
    GrayImage::from_raw(width, height, data).unwrap_or_default()
}

/// The mean of every 2x2 pixels.
pub(super) fn halved(image: &GrayImage) -> GrayImage {
    let (width, height) = (image.width() as usize, image.height() as usize);
    let data = image.as_raw();
    let mut half = Vec::with_capacity(width / 2 * (height / 2));
    for y in (0..height / 2 * 2).step_by(2) {
        for x in (0..width / 2 * 2).step_by(2) {
            let at = |dx: usize, dy: usize| u32::from(data[(y + dy) * width + x + dx]);
            half.push(((at(0, 0) + at(1, 0) + at(0, 1) + at(1, 1) + 2) / 4) as u8);
        }
    }
    GrayImage::from_raw(width as u32 / 2, height as u32 / 2, half).unwrap_or_default()
}

/// Variance of the Laplacian (Pech-Pacheco et al., "Diatom autofocusing in brightfield microscopy", 2000), at half size,
/// where the noise of single pixels is no detail.
fn detail(image: &GrayImage) -> f64 {
    let half = halved(image);
    let (width, height) = (half.width() as usize, half.height() as usize);
    let data = half.as_raw();
    let (mut count, mut sum, mut squares) = (0.0, 0.0, 0.0);
    for y in 1..height.saturating_sub(1) {
        for x in 1..width.saturating_sub(1) {
            let at = |i: usize| f64::from(data[i]);
            let i = y * width + x;
            let laplacian = at(i - 1) + at(i + 1) + at(i - width) + at(i + width) - 4.0 * at(i);
            (count, sum, squares) = (count + 1.0, sum + laplacian, squares + laplacian * laplacian);
        }
    }
    if count == 0.0 { 0.0 } else { squares / count - (sum / count).powi(2) }
}

fn most_frequent(sizes: &[(u32, u32)]) -> Option<(u32, u32)> {
    let count = |size: &(u32, u32)| sizes.iter().filter(|other| *other == size).count();
    let mut distinct = sizes.to_vec();
    distinct.sort_unstable();
    distinct.dedup();
    distinct.into_iter().max_by_key(count)
}

fn chain(error: &dyn std::error::Error) -> String {
    match error.source() {
        Some(source) => format!("{error}: {}", chain(source)),
        None => error.to_string(),
    }
}
