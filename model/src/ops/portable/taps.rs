//! What a square kernel sees of a map at each of its taps, as views of one padded map, and the way back.

use candle_core::{Result, Tensor};

/// A square odd kernel that moves over maps with padding (kernel - 1) / 2.
///
/// A side of the padded map is cut into cells of `stride` pixels, so that tap t of output o is pixel t % stride of cell
/// o + t / stride: a view, without indices.
#[derive(Debug, Clone, Copy)]
pub(super) struct Taps {
    pub(super) kernel: usize,
    pub(super) stride: usize,
    pub(super) height: usize,
    pub(super) width: usize,
}

impl Taps {
    /// Height and width of the outputs.
    pub(super) fn out(&self) -> (usize, usize) {
        (self.height.div_ceil(self.stride), self.width.div_ceil(self.stride))
    }

    /// Number of taps.
    pub(super) fn count(&self) -> usize {
        self.kernel * self.kernel
    }

    /// Cells of a side with so many outputs.
    fn cells(&self, out: usize) -> usize {
        out + (self.kernel - 1).div_ceil(self.stride)
    }

    /// Padding before the first pixel of a side.
    fn before(&self) -> usize {
        (self.kernel - 1) / 2
    }

    /// (M, H, W) -> (M, padded height, padded width).
    pub(super) fn pad(&self, x: &Tensor, value: f32) -> Result<Tensor> {
        let (rows, columns) = self.out();
        let after = |length, out| self.cells(out) * self.stride - length - self.before();
        let x = pad(x, 1, self.before(), after(self.height, rows), value)?;
        pad(&x, 2, self.before(), after(self.width, columns), value)
    }

    /// The pixels under one tap for every output, a view: (M, padded height, padded width) -> (M, rows, columns).
    pub(super) fn view(&self, padded: &Tensor, tap: usize) -> Result<Tensor> {
        let (rows, columns) = self.out();
        let (y, x) = (tap / self.kernel, tap % self.kernel);
        if self.stride == 1 {
            return padded.narrow(1, y, rows)?.narrow(2, x, columns);
        }
        let (maps, s) = (padded.dim(0)?, self.stride);
        // (M, cells, pixel in the cell, cells, pixel in the cell)
        let cells = padded.reshape((maps, self.cells(rows), s, self.cells(columns), s))?;
        let view = cells.narrow(1, y / s, rows)?.narrow(2, y % s, 1)?;
        view.narrow(3, x / s, columns)?.narrow(4, x % s, 1)?.squeeze(4)?.squeeze(2)
    }

    /// The reverse of all views: adds each tap's (M, rows, columns) to the pixels that it saw -> (M, H, W).
    pub(super) fn scatter(&self, by_tap: &[Tensor]) -> Result<Tensor> {
        let (rows, columns) = self.out();
        let (cell_rows, cell_columns) = (self.cells(rows), self.cells(columns));
        let first = &by_tap[0];
        let maps = first.dim(0)?;
        // Sum over the taps that see the same pixel of a cell.
        let pixel = |y: usize, x: usize| {
            let mut sum: Option<Tensor> = None;
            for (tap, values) in by_tap.iter().enumerate() {
                let (down, right) = (tap / self.kernel, tap % self.kernel);
                if (down % self.stride, right % self.stride) != (y, x) {
                    continue;
                }
                let (down, right) = (down / self.stride, right / self.stride);
                let values = pad(values, 1, down, cell_rows - rows - down, 0.0)?;
                let values = pad(&values, 2, right, cell_columns - columns - right, 0.0)?;
                sum = Some(match sum {
                    Some(sum) => (sum + values)?,
                    None => values,
                });
            }
            match sum {
                Some(sum) => Ok(sum),
                None => Tensor::zeros((maps, cell_rows, cell_columns), first.dtype(), first.device()),
            }
        };
        let s = self.stride;
        let by_row = |y| {
            let pixels = (0..s).map(|x| pixel(y, x)).collect::<Result<Vec<_>>>()?;
            Tensor::stack(&pixels, 3) // s x (M, cells, cells) -> (M, cells, cells, s)
        };
        let rows_of_cells = (0..s).map(by_row).collect::<Result<Vec<_>>>()?;
        let padded = Tensor::stack(&rows_of_cells, 2)?; // s x (M, cells, cells, s) -> (M, cells, s, cells, s)
        let padded = padded.reshape((maps, cell_rows * s, cell_columns * s))?;
        padded.narrow(1, self.before(), self.height)?.narrow(2, self.before(), self.width)?.contiguous()
    }
}

/// Puts `before` and `after` times `value` around one dimension.
fn pad(x: &Tensor, dim: usize, before: usize, after: usize, value: f32) -> Result<Tensor> {
    let side = |length: usize| {
        let mut shape = x.dims().to_vec();
        shape[dim] = length;
        Tensor::full(value, shape, x.device())
    };
    let mut parts = Vec::with_capacity(3);
    if before > 0 {
        parts.push(side(before)?);
    }
    parts.push(x.contiguous()?);
    if after > 0 {
        parts.push(side(after)?);
    }
    Tensor::cat(&parts, dim)
}
