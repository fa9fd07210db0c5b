//! One depth for each pixel, out of what each depth would cost.

use super::sweep::{PLANES, Planes};

/// Price of a step to the next plane between neighbouring pixels.
const STEP: f32 = 0.08;
/// Price of any other step, where the image is even.
const JUMP: f32 = 0.6;
/// Grey levels between neighbours at which a jump costs half: depth jumps where the picture has an edge.
const EDGE: f32 = 8.0;

/// Inverse depth of each pixel, row by row: semi-global matching along four paths, refined between planes by a parabola, and a median of
/// nine.
pub(super) fn inverse_depth(
    cost: &[f32],
    guide: &[f32],
    (width, height): (usize, usize),
    planes: &Planes,
) -> Vec<f32> {
    let mut total = vec![0.0; cost.len()];
    let across = |y: usize| (0..width).map(move |x| y * width + x);
    let down = |x: usize| (0..height).map(move |y| y * width + x);
    for y in 0..height {
        follow(across(y), cost, guide, &mut total);
        follow(across(y).rev(), cost, guide, &mut total);
    }
    for x in 0..width {
        follow(down(x), cost, guide, &mut total);
        follow(down(x).rev(), cost, guide, &mut total);
    }
    let found: Vec<f32> = total.chunks_exact(PLANES).map(|costs| planes.at(best(costs))).collect();
    median(&found, (width, height))
}

/// Adds to `total` the least cost of each depth along a path of pixels, as far as it has come.
fn follow(path: impl Iterator<Item = usize>, cost: &[f32], guide: &[f32], total: &mut [f32]) {
    // A border on both sides saves asking for the first and the last plane.
    let mut before = [f32::INFINITY; PLANES + 2];
    let mut now = before;
    let mut last: Option<usize> = None;
    for pixel in path {
        let own = &cost[pixel * PLANES..][..PLANES];
        let sum = &mut total[pixel * PLANES..][..PLANES];
        if let Some(last) = last {
            let jump = (JUMP / (1.0 + (guide[pixel] - guide[last]).abs() / EDGE)).max(1.5 * STEP);
            let least = before[1..=PLANES].iter().copied().fold(f32::INFINITY, f32::min);
            for plane in 0..PLANES {
                let step = before[plane].min(before[plane + 2]) + STEP;
                let way = before[plane + 1].min(step).min(least + jump);
                now[plane + 1] = own[plane] + way - least;
            }
        } else {
            now[1..=PLANES].copy_from_slice(own);
        }
        for (sum, now) in sum.iter_mut().zip(&now[1..=PLANES]) {
            *sum += now;
        }
        std::mem::swap(&mut before, &mut now);
        last = Some(pixel);
    }
}

/// The cheapest plane, between planes where its neighbours say so.
fn best(costs: &[f32]) -> f32 {
    let mut plane = 0;
    for (index, cost) in costs.iter().enumerate() {
        if *cost < costs[plane] {
            plane = index;
        }
    }
    if plane == 0 || plane == costs.len() - 1 {
        return plane as f32;
    }
    let (below, here, above) = (costs[plane - 1], costs[plane], costs[plane + 1]);
    let bend = (below - 2.0 * here + above).max(1e-6);
    plane as f32 + (0.5 * (below - above) / bend).clamp(-0.5, 0.5)
}

fn median(values: &[f32], (width, height): (usize, usize)) -> Vec<f32> {
    let near = |at: usize, offset: usize, last: usize| (at + offset).saturating_sub(1).min(last);
    let at = |pixel: usize| {
        let (x, y) = (pixel % width, pixel / width);
        let mut nine: [f32; 9] =
            std::array::from_fn(|i| values[near(y, i / 3, height - 1) * width + near(x, i % 3, width - 1)]);
        nine.sort_unstable_by(f32::total_cmp);
        nine[4]
    };
    (0..values.len()).map(at).collect()
}
