//! Buffers that a thread keeps for its next product: fresh ones would be mapped and zeroed by the kernel every time.

use std::cell::RefCell;

thread_local! {
    static KEPT: RefCell<Vec<Vec<f32>>> = const { RefCell::new(Vec::new()) };
}

/// Lends a buffer of `length` numbers of any value to `work`. Nested loans get buffers of their own.
pub(super) fn with<R>(length: usize, work: impl FnOnce(&mut [f32]) -> R) -> R {
    // The list is not borrowed while `work` runs: rayon may start another loan on this thread meanwhile.
    let mut buffer = KEPT.with_borrow_mut(Vec::pop).unwrap_or_default();
    if buffer.len() < length {
        buffer.resize(length, 0.0);
    }
    let result = work(&mut buffer[..length]);
    KEPT.with_borrow_mut(|kept| kept.push(buffer));
    result
}
