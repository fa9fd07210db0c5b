//! The fence around the `gemm` crate, whose interface takes raw pointers: matrix products of slices, bounds checked.
//!
//! Single-threaded on purpose: the callers split the work, and a product split by the crate could not be nested in it.
#![allow(unsafe_code, reason = "the gemm crate offers raw pointers only")]

use std::ops::Range;

/// A matrix of numbers that lie anywhere in a slice, one step apart per column or per row.
#[derive(Debug, Clone, Copy)]
pub(super) struct Matrix<'a> {
    values: &'a [f32],
    rows: usize,
    columns: usize,
    row_stride: usize,
    column_stride: usize,
}

impl<'a> Matrix<'a> {
    /// Row after row, without gaps.
    ///
    /// # Panics
    /// When the slice has another length than rows times columns.
    pub(super) fn packed(values: &'a [f32], rows: usize, columns: usize) -> Self {
        assert_eq!(values.len(), rows * columns, "a {rows}x{columns} matrix");
        Self { values, rows, columns, row_stride: columns, column_stride: 1 }
    }

    /// Rows and columns exchanged, without copying.
    pub(super) fn transposed(self) -> Self {
        Self {
            rows: self.columns,
            columns: self.rows,
            row_stride: self.column_stride,
            column_stride: self.row_stride,
            ..self
        }
    }

    /// Some of the rows.
    ///
    /// # Panics
    /// When the range reaches beyond the last row.
    pub(super) fn rows(self, range: Range<usize>) -> Self {
        assert!(range.start < range.end && range.end <= self.rows, "rows {range:?} of {}", self.rows);
        Self { values: &self.values[range.start * self.row_stride..], rows: range.len(), ..self }
    }

    /// How many rows it has.
    pub(super) fn row_count(&self) -> usize {
        self.rows
    }

    /// Index of the last element plus one; 0 for an empty matrix.
    fn extent(&self) -> usize {
        if self.rows == 0 || self.columns == 0 {
            return 0;
        }
        (self.rows - 1) * self.row_stride + (self.columns - 1) * self.column_stride + 1
    }
}

/// `target = a b`, or `target += a b`; the target is packed row after row.
///
/// # Panics
/// When the shapes do not fit each other.
pub(super) fn multiply(target: &mut [f32], accumulate: bool, a: Matrix<'_>, b: Matrix<'_>) {
    let (m, n, k) = (a.rows, b.columns, a.columns);
    assert_eq!(k, b.rows, "columns of the left and rows of the right matrix");
    assert_eq!(target.len(), m * n, "a {m}x{n} product");
    assert!(
        a.extent() <= a.values.len() && b.extent() <= b.values.len(),
        "a matrix reaches out of its slice"
    );
    let stride = |step: usize| isize::try_from(step).expect("a slice is never longer than isize::MAX");
    // SAFETY: `target` holds m * n elements and is written as an m x n matrix of row stride n and column stride 1. The
    // elements of `a` (m x k) and `b` (k x n) end at their extents, which lie within their slices (asserted above). The
    // exclusive borrow of `target` keeps it apart from both.
    unsafe {
        gemm::gemm(
            m,
            n,
            k,
            target.as_mut_ptr(),
            1,
            stride(n),
            accumulate,
            a.values.as_ptr(),
            stride(a.column_stride),
            stride(a.row_stride),
            b.values.as_ptr(),
            stride(b.column_stride),
            stride(b.row_stride),
            1.0,
            1.0,
            false,
            false,
            false,
            gemm::Parallelism::None,
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn numbers(count: usize, seed: usize) -> Vec<f32> {
        (0..count).map(|i| ((i * 7919 + seed) % 101) as f32 / 50.0 - 1.0).collect()
    }

    #[test]
    fn products_equal_the_definition_in_every_orientation() {
        for (m, n, k) in [(1, 1, 1), (3, 5, 2), (17, 33, 40), (5, 1, 9), (64, 7, 70)] {
            let (a, b) = (numbers(m * k, 1), numbers(k * n, 2));
            let (a_turned, b_turned): (Vec<f32>, Vec<f32>) = (
                (0..k * m).map(|i| a[(i % m) * k + i / m]).collect(),
                (0..n * k).map(|i| b[(i % k) * n + i / k]).collect(),
            );
            let left = [Matrix::packed(&a, m, k), Matrix::packed(&a_turned, k, m).transposed()];
            let right = [Matrix::packed(&b, k, n), Matrix::packed(&b_turned, n, k).transposed()];
            for (left, right) in left.into_iter().flat_map(|l| right.map(|r| (l, r))) {
                let mut target = vec![0.5; m * n];
                multiply(&mut target, true, left, right);
                for (i, found) in target.iter().enumerate() {
                    let terms = (0..k).map(|t| a[i / n * k + t] * b[t * n + i % n]);
                    assert!((terms.sum::<f32>() + 0.5 - found).abs() < 1e-5, "{m}x{n}x{k} at {i}");
                }
            }
        }
    }

    #[test]
    fn some_rows_of_a_product() {
        let (a, b) = (numbers(6 * 4, 3), numbers(4 * 5, 4));
        let (mut whole, mut part) = (vec![0.0; 30], vec![0.0; 10]);
        multiply(&mut whole, false, Matrix::packed(&a, 6, 4), Matrix::packed(&b, 4, 5));
        multiply(&mut part, false, Matrix::packed(&a, 6, 4).rows(3..5), Matrix::packed(&b, 4, 5));
        assert_eq!(part, whole[15..25]);
    }

    #[test]
    #[should_panic(expected = "rows 5..7 of 6")]
    fn rows_beyond_the_last_are_refused() {
        let _ = Matrix::packed(&[0.0; 12], 6, 2).rows(5..7);
    }
}
