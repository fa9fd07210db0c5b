//! Convolution and its two gradients on the CPU as matrix products of columns.
//!
//! The work is cut by shapes alone and every sum has a fixed order, so that results do not depend on the number of
//! threads.

use std::borrow::Cow;

use rayon::prelude::*;

use super::gemm::{Matrix, multiply};
use super::geometry::Geometry;
use super::scratch;

/// Below this many products the channels of each are cut as well, so that every core has work.
const FEW_PRODUCTS: usize = 16;
/// Channels of one piece of a cut product: enough that the columns are not packed too often.
const CHANNELS_PER_PIECE: usize = 64;
/// Columns' rows of one piece of a weight gradient.
const TAPS_PER_PIECE: usize = 128;
/// Pieces of a weight gradient: few images or few taps still keep this many cores busy.
const PIECES: usize = 8;

/// Images (N, inputs, H, W) and weights (outputs, taps) -> (N, outputs, out height, out width).
pub(super) fn forward(g: &Geometry, weight: Matrix<'_>, x: &[f32]) -> Vec<f32> {
    let per = g.images_per_product();
    let cut = g.images.div_ceil(per) < FEW_PRODUCTS;
    let mut y = vec![0.0; g.images * g.out_image()];
    let products = y.par_chunks_mut(per * g.out_image()).zip(x.par_chunks(per * g.image()));
    products.for_each(|(y, x)| product(g, weight, x, y, cut));
    y
}

/// Gradient of the images, of the gradient `dy` of the outputs; `weight` is (outputs, inputs, k, k).
pub(super) fn input_gradient(g: &Geometry, weight: &[f32], dy: &[f32]) -> Vec<f32> {
    if g.stride == 1 {
        // The gradient of a convolution is the convolution with the kernels turned round and the channels exchanged.
        let reverse = Geometry { inputs: g.outputs, outputs: g.inputs, ..*g };
        return if g.kernel == 1 {
            forward(&reverse, Matrix::packed(weight, g.outputs, g.inputs).transposed(), dy)
        } else {
            let turned = turned(g, weight);
            forward(&reverse, Matrix::packed(&turned, g.inputs, reverse.taps()), dy)
        };
    }
    let by_tap = Matrix::packed(weight, g.outputs, g.taps()).transposed(); // (taps, outputs)
    let area = g.kernel * g.kernel;
    let channels = CHANNELS_PER_PIECE.div_ceil(area);
    let mut dx = vec![0.0; g.images * g.image()];
    let images = dx.par_chunks_mut(g.image()).zip(dy.par_chunks(g.out_image()));
    images.for_each(|(dx, dy)| {
        dx.par_chunks_mut(channels * g.map()).enumerate().for_each(|(piece, maps)| {
            let first = piece * channels * area;
            let taps = first..first + maps.len() / g.map() * area;
            scratch::with(taps.len() * g.out_map(), |columns| {
                let dy = Matrix::packed(dy, g.outputs, g.out_map());
                multiply(columns, false, by_tap.rows(taps.clone()), dy);
                g.scatter(columns, taps, maps);
            });
        });
    });
    dx
}

/// Gradient of the weights, (outputs, inputs, k, k), of the gradient `dy` of the outputs.
pub(super) fn weight_gradient(g: &Geometry, x: &[f32], dy: &[f32]) -> Vec<f32> {
    let per = g.images_per_product();
    let dy = side_by_side(dy, per, g.outputs, g.out_map());
    let products = g.images.div_ceil(per);
    let tap_pieces = g.taps().div_ceil(TAPS_PER_PIECE);
    let image_pieces = PIECES.div_ceil(tap_pieces).min(products);
    let products_per_piece = products.div_ceil(image_pieces);
    let image_pieces = products.div_ceil(products_per_piece);
    // Part (t, i): the sum over piece i of the images for piece t of the taps, (outputs, taps of the piece).
    let parts: Vec<Vec<f32>> = (0..tap_pieces * image_pieces)
        .into_par_iter()
        .map(|part| {
            let first = part / image_pieces * TAPS_PER_PIECE;
            let taps = first..(first + TAPS_PER_PIECE).min(g.taps());
            let mut sum = vec![0.0; g.outputs * taps.len()];
            let images = per * products_per_piece;
            let first_image = part % image_pieces * images;
            let range =
                |image: usize| first_image * image..((first_image + images) * image).min(g.images * image);
            let products = x[range(g.image())].chunks(per * g.image());
            for (x, dy) in products.zip(dy[range(g.out_image())].chunks(per * g.out_image())) {
                let columns = x.len() / g.image() * g.out_map();
                let dy = Matrix::packed(dy, g.outputs, columns);
                if g.is_pointwise() && columns == g.out_map() {
                    let x = Matrix::packed(x, g.inputs, columns).rows(taps.clone());
                    multiply(&mut sum, true, dy, x.transposed());
                } else {
                    scratch::with(taps.len() * columns, |rows| {
                        g.columns(x, taps.clone(), rows);
                        let rows = Matrix::packed(rows, taps.len(), columns);
                        multiply(&mut sum, true, dy, rows.transposed());
                    });
                }
            }
            sum
        })
        .collect();
    let mut gradient = vec![0.0; g.outputs * g.taps()];
    gradient.par_chunks_mut(g.taps()).enumerate().for_each(|(output, row)| {
        for (piece, target) in row.chunks_mut(TAPS_PER_PIECE).enumerate() {
            for part in &parts[piece * image_pieces..(piece + 1) * image_pieces] {
                let source = &part[output * target.len()..(output + 1) * target.len()];
                target.iter_mut().zip(source).for_each(|(target, source)| *target += source);
            }
        }
    });
    gradient
}

/// The images that share one product.
fn product(g: &Geometry, weight: Matrix<'_>, x: &[f32], y: &mut [f32], cut: bool) {
    let images = x.len() / g.image();
    let columns = images * g.out_map();
    if g.is_pointwise() && images == 1 {
        return by_channels(weight, Matrix::packed(x, g.inputs, columns), y, cut);
    }
    scratch::with(g.taps() * columns, |rows| {
        if cut {
            let pieces = rows.par_chunks_mut(CHANNELS_PER_PIECE * columns).enumerate();
            pieces.for_each(|(piece, rows)| {
                let first = piece * CHANNELS_PER_PIECE;
                g.columns(x, first..first + rows.len() / columns, rows);
            });
        } else {
            g.columns(x, 0..g.taps(), rows);
        }
        let rows = Matrix::packed(rows, g.taps(), columns);
        if images == 1 {
            return by_channels(weight, rows, y, cut);
        }
        scratch::with(g.outputs * columns, |together| {
            by_channels(weight, rows, together, cut);
            // (outputs, images, out map) -> (images, outputs, out map)
            for (image, y) in y.chunks_exact_mut(g.out_image()).enumerate() {
                for (channel, map) in y.chunks_exact_mut(g.out_map()).enumerate() {
                    map.copy_from_slice(&together[channel * columns + image * g.out_map()..][..g.out_map()]);
                }
            }
        });
    });
}

/// `y = weight x`, on request in pieces of some rows each.
fn by_channels(weight: Matrix<'_>, x: Matrix<'_>, y: &mut [f32], cut: bool) {
    let columns = y.len() / weight.row_count();
    if !cut {
        return multiply(y, false, weight, x);
    }
    y.par_chunks_mut(CHANNELS_PER_PIECE * columns).enumerate().for_each(|(piece, y)| {
        let first = piece * CHANNELS_PER_PIECE;
        multiply(y, false, weight.rows(first..first + y.len() / columns), x);
    });
}

/// Weights (outputs, inputs, k, k) -> (inputs, outputs, k, k), each kernel turned by half a turn.
fn turned(g: &Geometry, weight: &[f32]) -> Vec<f32> {
    let area = g.kernel * g.kernel;
    let mut turned = vec![0.0; weight.len()];
    turned.par_chunks_mut(g.outputs * area).enumerate().for_each(|(input, row)| {
        for (output, kernel) in row.chunks_exact_mut(area).enumerate() {
            let source = &weight[(output * g.inputs + input) * area..][..area];
            kernel.iter_mut().zip(source.iter().rev()).for_each(|(target, source)| *target = *source);
        }
    });
    turned
}

/// (N, C, map) -> for every `per` images (C, up to `per` images, map).
fn side_by_side(maps: &[f32], per: usize, channels: usize, map: usize) -> Cow<'_, [f32]> {
    if per == 1 {
        return Cow::Borrowed(maps);
    }
    let image = channels * map;
    let mut together = vec![0.0; maps.len()];
    together.par_chunks_mut(per * image).zip(maps.par_chunks(per * image)).for_each(|(together, maps)| {
        let images = maps.len() / image;
        for (channel, row) in together.chunks_exact_mut(images * map).enumerate() {
            for (target, image) in row.chunks_exact_mut(map).zip(maps.chunks_exact(image)) {
                target.copy_from_slice(&image[channel * map..][..map]);
            }
        }
    });
    Cow::Owned(together)
}
