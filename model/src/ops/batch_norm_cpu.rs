//! Batch norm on the CPU: one task per channel, so that a channel is read from the cache after the first pass.

use rayon::prelude::*;

use super::batch_norm::{Activation, Numbers};
use super::elu::elu;

/// Independent partial sums, as many as two or four vector registers hold.
const LANES: usize = 16;
/// Additions to each lane before it is emptied into a double.
const PER_LANE: usize = 64;

/// The maps of one channel, to be written.
type ChannelMaps<'a> = Vec<&'a mut [f32]>;

/// Sizes of a batch of maps (N, C, map).
#[derive(Debug, Clone, Copy)]
pub(super) struct Maps {
    pub(super) images: usize,
    pub(super) channels: usize,
    pub(super) map: usize,
}

impl Maps {
    /// The maps of one channel, image by image.
    fn of<'a>(&self, values: &'a [f32], channel: usize) -> impl Iterator<Item = &'a [f32]> + Clone + use<'a> {
        let map = self.map;
        values[channel * map..].chunks(map).step_by(self.channels)
    }

    /// The maps of every channel, to be written.
    fn by_channel<'a>(&self, values: &'a mut [f32]) -> Vec<ChannelMaps<'a>> {
        let mut channels: Vec<ChannelMaps<'_>> =
            (0..self.channels).map(|_| Vec::with_capacity(self.images)).collect();
        for (i, map) in values.chunks_exact_mut(self.map).enumerate() {
            channels[i % self.channels].push(map);
        }
        channels
    }
}

/// Output and moments; the moments of `x` itself where none are given. `affine` is (2, C): weights, then biases.
pub(super) fn forward(
    maps: Maps,
    x: &[f32],
    affine: &[f32],
    given: Option<&Numbers>,
    eps: f64,
    residual: Option<&[f32]>,
    activation: Activation,
) -> (Vec<f32>, Numbers) {
    let mut y = vec![0.0; x.len()];
    let task = |(channel, y): (usize, ChannelMaps<'_>)| {
        pulp::Arch::new().dispatch(|| {
            let (mean, variance) = match given {
                Some(given) => (given.mean[channel], given.variance[channel]),
                None => channel_moments(maps, x, channel),
            };
            let scale = affine[channel] * inverse_deviation(variance, eps);
            let shift = affine[maps.channels + channel] - mean * scale;
            let mut residual = residual.map(|residual| maps.of(residual, channel));
            for (y, x) in y.into_iter().zip(maps.of(x, channel)) {
                let residual = residual.as_mut().and_then(Iterator::next);
                normalise(y, x, residual, scale, shift, activation);
            }
            (mean, variance)
        })
    };
    let moments = maps.by_channel(&mut y).into_par_iter().enumerate().map(task);
    let (mean, variance) = moments.unzip();
    (y, Numbers { mean, variance })
}

/// What the gradient needs of the forward pass, and the gradient of its output.
pub(super) struct Saved<'a> {
    pub(super) x: &'a [f32],
    pub(super) affine: &'a [f32],
    pub(super) y: &'a [f32],
    pub(super) dy: &'a [f32],
}

pub(super) struct Gradients {
    pub(super) x: Vec<f32>,
    /// (2, C): of the weights, then of the biases.
    pub(super) affine: Vec<f32>,
    pub(super) residual: Option<Vec<f32>>,
}

/// With z = weight (x - mean) / deviation + bias, y = activation(z + residual) and e = dL/dz:
///
/// dL/dweight = sum e (x - mean) / deviation, dL/dbias = sum e, dL/dresidual = e, and for moments of the batch
/// dL/dx = weight / deviation (e - mean of e - (x - mean) / deviation^2 mean of e (x - mean)).
pub(super) fn backward(
    maps: Maps,
    saved: Saved<'_>,
    moments: &Numbers,
    of_batch: bool,
    eps: f64,
    activation: Activation,
    wants_residual: bool,
) -> Gradients {
    let count = (maps.images * maps.map) as f64;
    let mut dx = vec![0.0; saved.x.len()];
    let mut dresidual = wants_residual.then(|| vec![0.0; saved.x.len()]);
    let residual_maps: Vec<_> = match &mut dresidual {
        Some(values) => maps.by_channel(values).into_iter().map(Some).collect(),
        None => (0..maps.channels).map(|_| None).collect(),
    };
    let task = |(channel, (dx, residual)): (usize, (ChannelMaps<'_>, Option<ChannelMaps<'_>>))| {
        pulp::Arch::new().dispatch(|| {
            let mean = moments.mean[channel];
            let inverse = inverse_deviation(moments.variance[channel], eps);
            let read = || {
                let (x, y) = (maps.of(saved.x, channel), maps.of(saved.y, channel));
                x.zip(y).zip(maps.of(saved.dy, channel)).map(|((x, y), dy)| (x, y, dy))
            };
            let (mut plain, mut centred) = (Sum::default(), Sum::default());
            for (x, y, dy) in read() {
                add_gradient_sums(&mut plain, &mut centred, x, y, dy, mean, activation);
            }
            let (sum, sum_centred) = (plain.total(), centred.total());
            let scale = saved.affine[channel] * inverse;
            // dx = scale e - offset - slope (x - mean)
            let (offset, slope) = if of_batch {
                let inverse = f64::from(inverse);
                let slope = f64::from(scale) * inverse * inverse * sum_centred / count;
                ((f64::from(scale) * sum / count) as f32, slope as f32)
            } else {
                (0.0, 0.0)
            };
            for (dx, (x, y, dy)) in dx.into_iter().zip(read()) {
                input_gradient(dx, x, y, dy, (mean, scale, offset, slope), activation);
            }
            for (target, (_, y, dy)) in residual.into_iter().flatten().zip(read()) {
                for ((target, y), dy) in target.iter_mut().zip(y).zip(dy) {
                    *target = through(activation, *y, *dy);
                }
            }
            ((sum_centred * f64::from(inverse)) as f32, sum as f32)
        })
    };
    let channels = maps.by_channel(&mut dx).into_par_iter().zip(residual_maps).enumerate();
    let (mut affine, biases): (Vec<f32>, Vec<f32>) = channels.map(task).unzip();
    affine.extend(biases);
    Gradients { x: dx, affine, residual: dresidual }
}

fn inverse_deviation(variance: f32, eps: f64) -> f32 {
    (f64::from(variance) + eps).sqrt().recip() as f32
}

/// The gradient before the activation, from its output.
#[inline(always)]
fn through(activation: Activation, y: f32, dy: f32) -> f32 {
    match activation {
        Activation::None => dy,
        Activation::Elu => dy * if y > 0.0 { 1.0 } else { y + 1.0 },
    }
}

#[inline(always)]
fn normalise(
    y: &mut [f32],
    x: &[f32],
    residual: Option<&[f32]>,
    scale: f32,
    shift: f32,
    activation: Activation,
) {
    match (residual, activation) {
        (None, Activation::None) => y.iter_mut().zip(x).for_each(|(y, x)| *y = x * scale + shift),
        (None, Activation::Elu) => y.iter_mut().zip(x).for_each(|(y, x)| *y = elu(x * scale + shift)),
        (Some(r), Activation::None) => {
            y.iter_mut().zip(x).zip(r).for_each(|((y, x), r)| *y = x * scale + shift + r);
        }
        (Some(r), Activation::Elu) => {
            y.iter_mut().zip(x).zip(r).for_each(|((y, x), r)| *y = elu(x * scale + shift + r));
        }
    }
}

#[inline(always)]
fn input_gradient(
    dx: &mut [f32],
    x: &[f32],
    y: &[f32],
    dy: &[f32],
    (mean, scale, offset, slope): (f32, f32, f32, f32),
    activation: Activation,
) {
    for (((dx, x), y), dy) in dx.iter_mut().zip(x).zip(y).zip(dy) {
        *dx = scale * through(activation, *y, *dy) - offset - slope * (x - mean);
    }
}

/// Mean and biased variance of one channel, in two passes.
#[inline(always)]
fn channel_moments(maps: Maps, x: &[f32], channel: usize) -> (f32, f32) {
    let count = (maps.images * maps.map) as f64;
    let mut sum = Sum::default();
    for x in maps.of(x, channel) {
        sum.add(x, |x| x);
    }
    let mean = (sum.total() / count) as f32;
    let mut squares = Sum::default();
    for x in maps.of(x, channel) {
        squares.add(x, |x| (x - mean) * (x - mean));
    }
    (mean, (squares.total() / count) as f32)
}

/// A sum in a fixed order: lanes of f32, emptied into an f64 before they lose digits.
#[derive(Default)]
struct Sum {
    lanes: [f32; LANES],
    pending: usize,
    total: f64,
}

impl Sum {
    #[inline(always)]
    fn add(&mut self, values: &[f32], term: impl Fn(f32) -> f32) {
        for block in values.chunks(LANES * PER_LANE) {
            let (chunks, rest) = block.as_chunks::<LANES>();
            self.room_for(chunks.len() + 1);
            let mut lanes = self.lanes;
            for chunk in chunks {
                for (lane, value) in lanes.iter_mut().zip(chunk) {
                    *lane += term(*value);
                }
            }
            for (lane, value) in lanes.iter_mut().zip(rest) {
                *lane += term(*value);
            }
            self.lanes = lanes;
        }
    }

    #[inline(always)]
    fn room_for(&mut self, additions: usize) {
        if self.pending + additions > PER_LANE {
            self.empty();
        }
        self.pending += additions;
    }

    #[inline(always)]
    fn empty(&mut self) {
        self.total += self.lanes.iter().map(|lane| f64::from(*lane)).sum::<f64>();
        self.lanes = [0.0; LANES];
        self.pending = 0;
    }

    #[inline(always)]
    fn total(mut self) -> f64 {
        self.empty();
        self.total
    }
}

/// Adds e to `plain` and e (x - mean) to `centred`.
#[inline(always)]
fn add_gradient_sums(
    plain: &mut Sum,
    centred: &mut Sum,
    x: &[f32],
    y: &[f32],
    dy: &[f32],
    mean: f32,
    activation: Activation,
) {
    const BLOCK: usize = LANES * PER_LANE;
    for ((x, y), dy) in x.chunks(BLOCK).zip(y.chunks(BLOCK)).zip(dy.chunks(BLOCK)) {
        let ((xs, x), (ys, y), (dys, dy)) =
            (x.as_chunks::<LANES>(), y.as_chunks::<LANES>(), dy.as_chunks::<LANES>());
        plain.room_for(xs.len() + 1);
        centred.room_for(xs.len() + 1);
        let (mut lanes, mut centred_lanes) = (plain.lanes, centred.lanes);
        for ((x, y), dy) in xs.iter().zip(ys).zip(dys) {
            for lane in 0..LANES {
                let e = through(activation, y[lane], dy[lane]);
                lanes[lane] += e;
                centred_lanes[lane] += e * (x[lane] - mean);
            }
        }
        for (lane, ((x, y), dy)) in x.iter().zip(y).zip(dy).enumerate() {
            let e = through(activation, *y, *dy);
            lanes[lane] += e;
            centred_lanes[lane] += e * (x - mean);
        }
        (plain.lanes, centred.lanes) = (lanes, centred_lanes);
    }
}
