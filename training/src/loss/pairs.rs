//! The frame pairs of the Cross Transformation Constraints (CTC), Eq. (2) and Fig. 4 of the paper.

/// Pairs (i, j) of a window of `k` frames: (i, i + s) for s = 1, 2, 4, 8, ... and i = 0, s, 2 s, ... while
/// i + s <= k - 1, and the whole window (0, k - 1) where it is not among them.
///
/// The paper draws K = 5 only; this is the rule that gives its seven pairs, in its order.
///
/// ```
/// use grnet_train::loss::pairs;
/// assert_eq!(pairs(5), [(0, 1), (1, 2), (2, 3), (3, 4), (0, 2), (2, 4), (0, 4)]);
/// ```
pub fn pairs(k: usize) -> Vec<(usize, usize)> {
    let spans = std::iter::successors(Some(1_usize), |s| Some(2 * s)).take_while(|s| *s < k);
    let mut pairs: Vec<_> =
        spans.flat_map(|s| (0..).step_by(s).map(move |i| (i, i + s)).take_while(|p| p.1 < k)).collect();
    if k > 1 && !pairs.contains(&(0, k - 1)) {
        pairs.push((0, k - 1));
    }
    pairs
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn short_windows() {
        assert_eq!(pairs(0), []);
        assert_eq!(pairs(1), []);
        assert_eq!(pairs(2), [(0, 1)]);
        assert_eq!(pairs(3), [(0, 1), (1, 2), (0, 2)]);
        assert_eq!(pairs(4), [(0, 1), (1, 2), (2, 3), (0, 2), (0, 3)]);
        assert_eq!(pairs(6), [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (0, 2), (2, 4), (0, 4), (0, 5)]);
    }

    #[test]
    fn every_window_of_the_papers_study() {
        // Steps, then spans of 2, of 4, of 8, and the whole window where that is none of them.
        let expected = [
            (2, [1, 0, 0, 0], 0),
            (3, [2, 1, 0, 0], 0),
            (4, [3, 1, 0, 0], 1),
            (5, [4, 2, 1, 0], 0),
            (6, [5, 2, 1, 0], 1),
            (7, [6, 3, 1, 0], 1),
            (8, [7, 3, 1, 0], 1),
            (9, [8, 4, 2, 1], 0),
            (10, [9, 4, 2, 1], 1),
            (11, [10, 5, 2, 1], 1),
        ];
        for (k, spans, whole) in expected {
            let pairs = pairs(k);
            for (span, count) in [1, 2, 4, 8].into_iter().zip(spans) {
                let of_span: Vec<_> = pairs.iter().filter(|(i, j)| j - i == span).collect();
                assert_eq!(of_span.len(), count, "K = {k}, span {span}");
                assert!(of_span.iter().all(|(i, _)| i % span == 0), "K = {k}: {pairs:?}");
            }
            assert_eq!(pairs.len(), spans.iter().sum::<usize>() + whole, "K = {k}: {pairs:?}");
            assert!(pairs.contains(&(0, k - 1)), "K = {k}: {pairs:?}");
            let distinct: std::collections::BTreeSet<_> = pairs.iter().collect();
            assert_eq!(distinct.len(), pairs.len(), "K = {k}: {pairs:?}");
        }
    }
}
