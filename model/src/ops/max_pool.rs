//! The stem's max-pool with its gradient.

use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor, bail};
use rayon::prelude::*;

use super::values::{slice, tensor, with_values};

/// 3x3 max-pool, stride 2, padding 1: (N, C, H, W) -> (N, C, ceil(H / 2), ceil(W / 2)).
///
/// The first of several equal maxima gets the gradient, as in PyTorch.
///
/// # Errors
/// When the input is not a map of four dimensions, or empty.
pub fn max_pool_3x3_stride_2(x: &Tensor) -> Result<Tensor> {
    let (_, _, height, width) = x.dims4()?;
    if x.elem_count() == 0 {
        bail!("no maximum in an empty map of shape {:?}", x.dims());
    }
    x.contiguous()?.apply_op1(MaxPool { height, width })
}

struct MaxPool {
    height: usize,
    width: usize,
}

impl MaxPool {
    fn out(&self) -> (usize, usize) {
        (self.height.div_ceil(2), self.width.div_ceil(2))
    }

    /// Index of the first maximum in the window of an output.
    fn argmax(&self, map: &[f32], row: usize, column: usize) -> usize {
        let rows = (2 * row).saturating_sub(1)..(2 * row + 2).min(self.height);
        let first = (2 * column).saturating_sub(1);
        let columns = (2 * column + 2).min(self.width) - first;
        let mut best = rows.start * self.width + first;
        for row in rows {
            let start = row * self.width + first;
            for (at, value) in map[start..start + columns].iter().enumerate() {
                // A NaN wins, so that a defect upstream stays visible.
                if *value > map[best] || value.is_nan() {
                    best = start + at;
                }
            }
        }
        best
    }

    /// Calls `visit` with every output of a map and the index of its maximum.
    fn each(&self, map: &[f32], mut visit: impl FnMut(usize, usize)) {
        let (rows, columns) = self.out();
        for row in 0..rows {
            for column in 0..columns {
                visit(row * columns + column, self.argmax(map, row, column));
            }
        }
    }
}

impl CustomOp1 for MaxPool {
    fn name(&self) -> &'static str {
        "max-pool"
    }

    fn cpu_fwd(&self, x: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let (n, channels, height, width) = layout.shape().dims4()?;
        let (rows, columns) = self.out();
        let mut y = vec![0.0; n * channels * rows * columns];
        let maps = y.par_chunks_mut(rows * columns).zip(slice(x, layout)?.par_chunks(height * width));
        maps.for_each(|(y, x)| self.each(x, |at, maximum| y[at] = x[maximum]));
        Ok((CpuStorage::F32(y), (n, channels, rows, columns).into()))
    }

    fn bwd(&self, x: &Tensor, _y: &Tensor, dy: &Tensor) -> Result<Option<Tensor>> {
        if !x.track_op() {
            return Ok(None);
        }
        let (rows, columns) = self.out();
        let dx = with_values([x, dy], |[x, dy]| {
            let mut dx = vec![0.0; x.len()];
            let map = self.height * self.width;
            let maps = dx.par_chunks_mut(map).zip(x.par_chunks(map)).zip(dy.par_chunks(rows * columns));
            maps.for_each(|((dx, x), dy)| self.each(x, |at, maximum| dx[maximum] += dy[at]));
            dx
        })?;
        tensor(dx, x.dims()).map(Some)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::{Device, Var};

    #[test]
    fn the_first_of_equal_maxima_gets_the_gradient() {
        let x = Var::zeros((1, 1, 3, 3), candle_core::DType::F32, &Device::Cpu).unwrap();
        let y = max_pool_3x3_stride_2(&x).unwrap();
        let gradient = y.backward().unwrap().remove(&x).unwrap();
        let expected = [1.0, 1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0];
        assert_eq!(gradient.flatten_all().unwrap().to_vec1::<f32>().unwrap(), expected);
    }
}
