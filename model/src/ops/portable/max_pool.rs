//! The stem's max-pool and its gradient.

use candle_core::{DType, Result, Tensor};

use super::given::{Gradient, attach1};
use super::taps::Taps;

/// 3x3 max-pool, stride 2, padding 1: (C, N, H, W) -> (C, N, ceil(H / 2), ceil(W / 2)).
pub(in crate::ops) fn max_pool_3x3_stride_2(x: &Tensor) -> Result<Tensor> {
    let (channels, images, height, width) = x.dims4()?;
    let pool = MaxPool { taps: Taps { kernel: 3, stride: 2, height, width } };
    let padded = pool.padded(&x.detach())?;
    let mut y = pool.taps.view(&padded, 0)?.contiguous()?;
    for tap in 1..pool.taps.count() {
        y = y.maximum(&pool.taps.view(&padded, tap)?)?;
    }
    let (rows, columns) = pool.taps.out();
    attach1(x, y.reshape((channels, images, rows, columns))?, pool)
}

struct MaxPool {
    taps: Taps,
}

impl MaxPool {
    fn padded(&self, x: &Tensor) -> Result<Tensor> {
        let maps = x.dim(0)? * x.dim(1)?;
        self.taps.pad(&x.contiguous()?.reshape((maps, self.taps.height, self.taps.width))?, f32::NEG_INFINITY)
    }
}

impl Gradient<1> for MaxPool {
    const NAME: &'static str = "portable max-pool";

    fn gradient(&self, [x]: [&Tensor; 1], y: &Tensor, dy: &Tensor) -> Result<[Option<Tensor>; 1]> {
        let padded = self.padded(&x.detach())?;
        let (maps, (rows, columns)) = (padded.dim(0)?, self.taps.out());
        let (y, mut left) = (y.detach().reshape((maps, rows, columns))?, dy.reshape((maps, rows, columns))?);
        let mut by_tap = Vec::with_capacity(self.taps.count());
        for tap in 0..self.taps.count() {
            // The first of equal maxima takes all of the gradient.
            let is_maximum = self.taps.view(&padded, tap)?.contiguous()?.eq(&y)?.to_dtype(DType::F32)?;
            let taken = (&left * is_maximum)?;
            left = (left - &taken)?;
            by_tap.push(taken);
        }
        Ok([Some(self.taps.scatter(&by_tap)?.reshape(x.shape())?)])
    }
}
