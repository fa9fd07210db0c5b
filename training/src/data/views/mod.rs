//! Views of a recorded place from where the camera never was.
//!
//! A recording of a minute is a thread through the room: a network that only ever stood on it says little from half a metre
//! beside it, and a robot drives there. The recording knows more than it shows: frames whose poses are known give the depth of
//! what they see, and with it every frame can be drawn from a camera moved aside, its pose moved with it. Large motions
//! with their parallax, which a recording has few of, come for nothing.
//!
//! | module | what it does |
//! |---|---|
//! | `neighbours` | which frames see a frame's scene from beside it |
//! | `sweep` | plane sweep (Collins 1996): how alike they are at each depth |
//! | `smooth` | semi-global matching (Hirschmüller 2008): the depth of each pixel |
//! | `agree` | the median of that and of what the neighbours see there |
//! | `helpers` | which frames show what a frame does not, once its camera is elsewhere |
//! | `draw` | what a camera elsewhere sees, out of these frames |
//!
//! Depth is rough (48 planes, an image of some hundred pixels), and what none of these frames saw is filled from the
//! background: good enough to learn from, not to measure in. As all training data it is a pure function of the recording, in IEEE
//! arithmetic.

mod agree;
mod draw;
mod helpers;
mod neighbours;
mod smooth;
mod sweep;

use std::sync::{Arc, OnceLock};

use grnet_geometry::Pose;
use nalgebra::Vector3;
use rand::Rng;
use serde::{Deserialize, Serialize};

use super::DataError;
use super::augment::Border;
use super::image::{Lens, Rgb};
use super::window::{Purpose, check_share, generator};

use draw::Part;

pub(crate) use draw::Artist;

/// Frames at most that show what a frame does not.
const HELPERS: usize = 3;

/// How windows of a recording are seen from elsewhere.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ViewOptions {
    /// Share of the windows that are not plain.
    pub share: f64,
    /// Largest shift of the camera along each of its axes in metres, the same for all frames of a window.
    pub shift_m: f64,
    /// Largest further shift of each frame of its own in metres: motions that were never recorded.
    pub frame_shift_m: f64,
    /// Nearest and farthest depth that is looked for, in metres along the optical axis.
    pub depth_m: (f64, f64),
}

impl Default for ViewOptions {
    fn default() -> Self {
        Self { share: 0.7, shift_m: 0.3, frame_shift_m: 0.03, depth_m: (0.5, 8.0) }
    }
}

impl ViewOptions {
    pub(crate) fn check(&self, input_px: (u32, u32)) -> Result<(), DataError> {
        const LEAST_PX: u32 = 32;
        if input_px.0.min(input_px.1) < LEAST_PX {
            let found = format!("a network that sees {}x{} pixels", input_px.0, input_px.1);
            return Err(DataError::option(
                "views",
                found,
                "at least 32 pixels along each side to find depth in",
            ));
        }
        check_share("views.share", self.share)?;
        for (option, value) in [("views.shift_m", self.shift_m), ("views.frame_shift_m", self.frame_shift_m)]
        {
            if !(0.0..=100.0).contains(&value) {
                return Err(DataError::option(option, value, "0 to 100 metres"));
            }
        }
        let (near, far) = self.depth_m;
        if !(near > 0.0 && near < far && far.is_finite()) {
            let found = format!("[{near}, {far}]");
            return Err(DataError::option("views.depth_m", found, "two depths in metres, the nearer first"));
        }
        Ok(())
    }
}

/// Inverse depth of each pixel of a stored image, 1/m, row by row.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Surface {
    pub width: usize,
    pub height: usize,
    pub inverse_depth: Vec<f32>,
}

/// A camera and where it stood.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Station {
    pub world_from_camera: Pose,
    /// Of the stored image.
    pub lens: Lens,
    /// Width and height of the stored image in pixels.
    pub size_px: (u32, u32),
}

/// The depths of a recording's frames, each found when it is first needed.
#[derive(Debug, Clone)]
pub(crate) struct Views {
    options: ViewOptions,
    stations: Vec<Station>,
    known: Arc<Vec<Known>>,
}

/// What has been found of a frame.
#[derive(Debug, Default)]
struct Known {
    neighbours: OnceLock<Vec<usize>>,
    /// By itself.
    alone: OnceLock<Surface>,
    /// As its neighbours see it, too.
    surface: OnceLock<Surface>,
}

impl Views {
    pub fn new(options: ViewOptions, stations: Vec<Station>) -> Self {
        let known = Arc::new(stations.iter().map(|_| Known::default()).collect());
        Self { options, stations, known }
    }

    /// Uses the depths of `other`, which has the same images, where it sees them from the same places.
    pub fn share(&mut self, other: &Self) {
        if self.stations == other.stations && self.options.depth_m == other.options.depth_m {
            self.known = other.known.clone();
        }
    }

    /// Where the cameras of window `index` are moved to, in their own axes; `None`: they stay.
    pub fn shifts(&self, chosen: &[usize], seed: u64, index: u64) -> Option<Vec<Vector3<f64>>> {
        let mut rng = generator(seed, Purpose::View, index);
        if rng.random::<f64>() >= self.options.share {
            return None;
        }
        let mut shift = |most: f64| Vector3::from_fn(|_, _| most * rng.random_range(-1.0..=1.0));
        let first = &self.stations[chosen[0]].world_from_camera;
        let common = first.rotation * shift(self.options.shift_m);
        let shifts = chosen
            .iter()
            .map(|frame| {
                let camera_from_world = self.stations[*frame].world_from_camera.rotation.inverse();
                camera_from_world * common + shift(self.options.frame_shift_m)
            })
            .collect();
        chosen.iter().all(|frame| self.has_depth(*frame)).then_some(shifts)
    }

    /// Whether enough frames see the scene of this one from beside it.
    pub fn has_depth(&self, frame: usize) -> bool {
        self.neighbours(frame).len() >= 2
    }

    fn neighbours(&self, frame: usize) -> &[usize] {
        let find = || neighbours::of(frame, &self.stations, self.options.depth_m.0);
        self.known[frame].neighbours.get_or_init(find)
    }

    /// The view of a camera that stands at `frame_from_new`, beside a frame; `image` gives the stored image of a frame.
    pub fn draw<'a, E>(
        &self,
        artist: &'a mut Artist,
        (frame, frame_from_new): (usize, &Pose),
        (input, size): (Lens, (usize, usize)),
        (border, mean): (Border, [f32; 3]),
        mut image: impl FnMut(usize) -> Result<Arc<Rgb>, E>,
    ) -> Result<&'a Rgb, E> {
        let world_from_new = self.stations[frame].world_from_camera * frame_from_new;
        let (mut parts, mut used) = (Vec::new(), Vec::new());
        artist.begin(size);
        let mut next = Some(frame);
        while let Some(frame) = next {
            let Station { world_from_camera, lens, .. } = self.stations[frame];
            let surface = self.surface(frame, &mut image)?;
            let own_from_new = world_from_camera.inv_mul(&world_from_new);
            let part = Part { image: image(frame)?, lens, surface, own_from_new };
            artist.add(used.len() as u8, &part, input);
            parts.push(part);
            used.push(frame);
            if used.len() > HELPERS {
                break;
            }
            let missing = artist.missing(parts[0].surface, input);
            let is_used = |other: usize| used.contains(&other) || !self.has_depth(other);
            next = (!missing.is_empty())
                .then(|| helpers::best(&missing, &world_from_new, &self.stations, is_used))
                .flatten();
        }
        Ok(artist.finish(&parts, input, (border, mean)))
    }

    /// The depth of a frame.
    fn surface<E>(
        &self,
        frame: usize,
        image: &mut impl FnMut(usize) -> Result<Arc<Rgb>, E>,
    ) -> Result<&Surface, E> {
        let known = &self.known[frame].surface;
        if let Some(surface) = known.get() {
            return Ok(surface);
        }
        let own = (&self.stations[frame], self.alone(frame, image)?);
        let neighbours = self.neighbours(frame);
        let others = neighbours.iter().map(|other| Ok((&self.stations[*other], self.alone(*other, image)?)));
        let others = others.collect::<Result<Vec<_>, E>>()?;
        Ok(known.get_or_init(|| agree::median(own, &others)))
    }

    /// The depth of a frame by itself.
    fn alone<E>(
        &self,
        frame: usize,
        image: &mut impl FnMut(usize) -> Result<Arc<Rgb>, E>,
    ) -> Result<&Surface, E> {
        let known = &self.known[frame].alone;
        if let Some(surface) = known.get() {
            return Ok(surface);
        }
        let mut seen = |frame: usize| Ok((self.stations[frame], image(frame)?));
        let reference = seen(frame)?;
        let others =
            self.neighbours(frame).iter().map(|other| seen(*other)).collect::<Result<Vec<_>, E>>()?;
        Ok(known.get_or_init(|| find(&reference, &others, self.options.depth_m)))
    }
}

fn find(
    reference: &(Station, Arc<Rgb>),
    others: &[(Station, Arc<Rgb>)],
    (near_m, far_m): (f64, f64),
) -> Surface {
    let planes = sweep::Planes::between(near_m, far_m);
    let guide = sweep::grey(&reference.1);
    let cost = sweep::costs(reference, others, &planes);
    let (width, height) = (reference.1.width, reference.1.height);
    Surface { width, height, inverse_depth: smooth::inverse_depth(&cost, &guide, (width, height), &planes) }
}
