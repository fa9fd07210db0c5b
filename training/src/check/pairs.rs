//! Pairs of frames a few apart, with the corners that can be followed between them.

use grnet_capture::dataset::Recording;
use grnet_capture::decode::decode_file;
use grnet_frame::Camera;
use image::GrayImage;
use rayon::prelude::*;

use super::epipolar::{Pair, normalised};
use super::flow::{Point, Pyramid, corners};
use super::images::{grey, halved};

/// Pairs that are looked for in a recording.
const PAIRS: usize = 64;

/// Frames between the two of a pair, tried in this order until corners move far enough.
const GAPS: [usize; 6] = [1, 2, 4, 7, 11, 16];

/// The middle corner should move this far, as a share of the image's width.
const ENOUGH_MOTION: f64 = 0.05;

/// Less than this share is too close to the tracker's own error.
const LEAST_MOTION: f64 = 0.004;

/// Fewest corners of a pair.
const LEAST_TRACKS: usize = 25;

/// Wider images are halved: the tracker needs no more.
const WIDEST_PX: u32 = 1400;

/// Pairs spread over the recording, normalised with the given intrinsics.
pub fn collect(recording: &Recording, camera: &Camera) -> Vec<Pair> {
    let last = recording.frames.len().saturating_sub(1);
    let mut anchors: Vec<usize> = (0..PAIRS).map(|i| i * last / PAIRS).collect();
    anchors.dedup();
    anchors.par_iter().filter_map(|anchor| pair(recording, *anchor, camera)).collect()
}

fn pair(recording: &Recording, first: usize, camera: &Camera) -> Option<Pair> {
    let frames = &recording.frames;
    let (image, scale) = read(recording, first)?;
    let (pyramid, points) = (Pyramid::new(&image), corners(&image));
    let width = f64::from(image.width());
    let mut best = None;
    for gap in GAPS {
        let second = first + gap;
        // Gaps of the recording are no small motion.
        let is_near = frames.get(second).is_some_and(|f| f.sequence == frames[first].sequence + gap as u64);
        if !is_near {
            break;
        }
        let Some((other, _)) = read(recording, second) else { break };
        let followed = pyramid.follow(&Pyramid::new(&other), &points);
        let tracks: Vec<(Point, Point)> =
            points.iter().zip(&followed).filter_map(|(a, b)| Some((*a, (*b)?))).collect();
        if tracks.len() < LEAST_TRACKS || tracks.len() * 3 < points.len() {
            break;
        }
        let lengths: Vec<f64> = tracks.iter().map(|(a, b)| (b.0 - a.0).hypot(b.1 - a.1)).collect();
        let middle = grnet_geometry::statistics::median(&lengths)?;
        if middle > LEAST_MOTION * width {
            best = Some((second, tracks));
        }
        if middle > ENOUGH_MOTION * width {
            break;
        }
    }
    let (second, tracks) = best?;
    // Pixel centres are at integers: those of a halved image lie between four of the whole.
    let whole = |(x, y): Point| ((x + 0.5) * scale - 0.5, (y + 0.5) * scale - 0.5);
    let normalise =
        |(a, b): (Point, Point)| Some((normalised(camera, whole(a))?, normalised(camera, whole(b))?));
    let tracks = tracks.into_iter().filter_map(normalise).collect();
    Some(Pair { first, second, tracks })
}

/// A frame in grey, and how many pixels of it are one of the result.
fn read(recording: &Recording, index: usize) -> Option<(GrayImage, f64)> {
    let pixels = decode_file(&recording.frames[index].path).ok()?;
    if recording.image_size_px.is_some_and(|size| size != (pixels.width_px(), pixels.height_px())) {
        return None;
    }
    let (mut image, mut scale) = (grey(&pixels), 1.0);
    while image.width() > WIDEST_PX {
        (image, scale) = (halved(&image), scale * 2.0);
    }
    Some((image, scale))
}
