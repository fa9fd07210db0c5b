//! Batches made ahead of the trainer, in order.

use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;

use candle_core::{Device, Tensor};
use crossbeam_channel::{Receiver, Sender, bounded};
use grnet_geometry::Pose;

use super::{DataError, Windows};

/// Windows that are trained on together.
#[derive(Debug, Clone)]
pub struct Batch {
    /// (B, K, 3, H, W), single precision, in main memory.
    pub images: Tensor,
    /// B times K poses, metres.
    pub world_from_camera: Vec<Vec<Pose>>,
    /// What each window is called in errors.
    pub names: Vec<String>,
    /// Number of the batch: its window `i` has index `index * B + i`.
    pub index: u64,
}

/// Makes batches on threads of its own and hands them out in order.
///
/// At most `ahead` batches are finished or in the making beside the one handed out, so memory is bounded. An error is
/// handed out in the place of its batch; the next call goes on with the next batch. Dropping the loader stops its
/// threads: each ends with the window that it is making.
///
/// Without threads every batch is made by the caller, with the same result.
#[derive(Debug)]
pub struct Loader {
    make: Arc<Make>,
    next: u64,
    workers: Option<Workers>,
}

#[derive(Debug)]
struct Workers {
    /// Batches that may be made.
    orders: Sender<u64>,
    done: Receiver<(u64, Result<Batch, DataError>)>,
    /// Batches that were finished before their turn.
    early: BTreeMap<u64, Result<Batch, DataError>>,
    ordered: u64,
    threads: Vec<JoinHandle<()>>,
}

struct Make {
    windows: Arc<dyn Windows>,
    batch: usize,
    stop: AtomicBool,
}

impl Loader {
    /// Starts with batch `first_batch`; `ahead` counts batches, at least one for each thread is made ahead.
    pub fn start(
        windows: Arc<dyn Windows>,
        batch: usize,
        first_batch: u64,
        threads: usize,
        ahead: usize,
    ) -> Self {
        let make = Arc::new(Make { windows, batch: batch.max(1), stop: AtomicBool::new(false) });
        let workers = (threads > 0).then(|| Workers::start(&make, first_batch, threads, ahead));
        Self { make, next: first_batch, workers }
    }

    /// The next batch.
    ///
    /// # Errors
    /// When one of its windows cannot be made.
    #[expect(clippy::should_implement_trait, reason = "there is no last batch, so callers need no `Option`")]
    pub fn next(&mut self) -> Result<Batch, DataError> {
        let index = self.next;
        self.next += 1;
        match &mut self.workers {
            Some(workers) => workers.take(index),
            None => self.make.guarded(index),
        }
    }
}

impl Workers {
    fn start(make: &Arc<Make>, first_batch: u64, threads: usize, ahead: usize) -> Self {
        let ahead = ahead.max(threads);
        // Both channels hold all that can be under way, so nobody ever waits to send.
        let (orders, ordered_batches) = bounded::<u64>(ahead);
        let (finished, done) = bounded(ahead);
        let spawn = |number: usize| {
            let (make, orders, finished) = (make.clone(), ordered_batches.clone(), finished.clone());
            let name = format!("data-{number}");
            std::thread::Builder::new().name(name).spawn(move || make.work(&orders, &finished))
        };
        // Fewer threads than asked for do the same work; with none at all `take` says so.
        let threads = (0..threads).map_while(|number| spawn(number).ok()).collect();
        let ordered = first_batch + ahead as u64;
        for index in first_batch..ordered {
            let _ = orders.send(index);
        }
        Self { orders, done, early: BTreeMap::new(), ordered, threads }
    }

    fn take(&mut self, index: u64) -> Result<Batch, DataError> {
        let batch = loop {
            if let Some(batch) = self.early.remove(&index) {
                break batch;
            }
            let Ok((made, batch)) = self.done.recv() else {
                let reason = "no thread could be started, or all have ended".into();
                return Err(DataError::Threads { reason });
            };
            self.early.insert(made, batch);
        };
        if self.orders.send(self.ordered).is_ok() {
            self.ordered += 1;
        }
        batch
    }
}

impl Drop for Loader {
    fn drop(&mut self) {
        self.make.stop.store(true, Ordering::Relaxed);
        let Some(Workers { orders, done, threads, .. }) = self.workers.take() else { return };
        drop((orders, done));
        for thread in threads {
            // Panics of a window are caught where it is made; there is nothing to tell about here.
            let _ = thread.join();
        }
    }
}

impl Make {
    fn work(&self, orders: &Receiver<u64>, finished: &Sender<(u64, Result<Batch, DataError>)>) {
        while let Ok(index) = orders.recv() {
            if self.stop.load(Ordering::Relaxed) || finished.send((index, self.guarded(index))).is_err() {
                return;
            }
        }
    }

    /// A panic in a source must not leave the trainer waiting for ever.
    fn guarded(&self, index: u64) -> Result<Batch, DataError> {
        catch_unwind(AssertUnwindSafe(|| self.make(index))).unwrap_or_else(|panic| {
            let text = panic.downcast_ref::<&str>().map(ToString::to_string);
            let text = text.or_else(|| panic.downcast_ref::<String>().cloned());
            let reason = text.unwrap_or_else(|| "no message".into());
            Err(DataError::Panicked { batch: index, reason })
        })
    }

    fn make(&self, index: u64) -> Result<Batch, DataError> {
        let (count, k) = (self.batch, self.windows.k());
        let mut images = Vec::new();
        let mut world_from_camera = Vec::with_capacity(count);
        let mut names = Vec::with_capacity(count);
        let mut length = 0;
        for i in 0..count as u64 {
            if self.stop.load(Ordering::Relaxed) {
                return Err(DataError::Threads { reason: "the loader was dropped".into() });
            }
            let window = self.windows.window(index.wrapping_mul(count as u64).wrapping_add(i))?;
            if i == 0 {
                length = window.images.len();
                images.reserve_exact(length * count);
            }
            if (window.images.len(), window.world_from_camera.len()) != (length, k) {
                let shape = |numbers, poses| format!("{numbers} and {poses}");
                return Err(DataError::Shape {
                    name: window.name,
                    found: shape(window.images.len(), window.world_from_camera.len()),
                    expected: shape(length, k),
                });
            }
            images.extend_from_slice(&window.images);
            world_from_camera.push(window.world_from_camera);
            names.push(window.name);
        }
        let (width, height) = self.windows.size_px().map_or_else(
            || {
                let side = (length / (3 * k.max(1))).isqrt();
                (side, side)
            },
            |(width, height)| (width as usize, height as usize),
        );
        let images = Tensor::from_vec(images, (count, k, 3, height, width), &Device::Cpu)
            .map_err(|source| DataError::Tensor { batch: index, source })?;
        Ok(Batch { images, world_from_camera, names, index })
    }
}

impl std::fmt::Debug for Make {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} windows a batch from {}", self.batch, self.windows.describe())
    }
}

#[cfg(test)]
mod tests {
    use super::super::window::tests::Counting;
    use super::*;

    fn images(batch: &Batch) -> Vec<f32> {
        batch.images.flatten_all().unwrap().to_vec1().unwrap()
    }

    #[test]
    fn batches_come_in_order_and_are_the_same_for_every_number_of_threads() {
        let expected: Vec<Vec<f32>> = (7..30u64)
            .map(|b| (0..3).flat_map(|i| [(b * 3 + i) as f32, 4.0, 0.0].repeat(2)).collect())
            .collect();
        for threads in [0, 1, 2, 5] {
            let windows = Arc::new(Counting { k: 2, tag: 4.0, ..Counting::default() });
            let mut loader = Loader::start(windows, 3, 7, threads, 4);
            for (index, expected) in (7..).zip(&expected) {
                let batch = loader.next().unwrap();
                assert_eq!((batch.index, batch.images.dims()), (index, &[3, 2, 3, 1, 1][..]));
                assert_eq!(&images(&batch), expected, "batch {index}, {threads} threads");
                assert_eq!(batch.names[1], (index * 3 + 1).to_string());
                assert_eq!(batch.world_from_camera[2].len(), 2);
            }
        }
    }

    #[test]
    fn errors_and_panics_come_in_the_place_of_their_batch() {
        for threads in [0, 3] {
            let windows = Counting { k: 1, broken: vec![5], faulty: vec![13], ..Counting::default() };
            let mut loader = Loader::start(Arc::new(windows), 2, 0, threads, 8);
            let results: Vec<_> = (0..9).map(|_| loader.next()).collect();
            let good = |i: usize| results[i].as_ref().is_ok_and(|batch| batch.index == i as u64);
            assert!([0, 1, 3, 4, 5, 7, 8].into_iter().all(good));
            assert!(results[2].as_ref().unwrap_err().to_string().contains("found 5"));
            let panicked = results[6].as_ref().unwrap_err().to_string();
            assert!(panicked.contains("batch 6") && panicked.contains("window 13 is faulty"), "{panicked}");
        }
    }

    /// A source that never gives a window until it is let go, and tells when it was asked.
    struct Gate {
        asked: Sender<u64>,
        open: Receiver<()>,
    }

    impl Windows for Gate {
        fn k(&self) -> usize {
            1
        }

        fn window(&self, index: u64) -> Result<super::super::Window, DataError> {
            let _ = self.asked.send(index);
            let _ = self.open.recv();
            Counting { k: 1, ..Counting::default() }.window(index)
        }

        fn fingerprint(&self) -> String {
            String::new()
        }

        fn describe(&self) -> String {
            "gate".into()
        }
    }

    #[test]
    fn no_more_is_made_than_was_ordered_and_dropping_ends_the_threads() {
        let (asked, questions) = crossbeam_channel::unbounded();
        let (key, open) = crossbeam_channel::unbounded();
        let mut loader = Loader::start(Arc::new(Gate { asked, open }), 1, 0, 2, 3);
        let mut first: Vec<u64> = (0..2).map(|_| questions.recv().unwrap()).collect();
        first.sort_unstable();
        assert_eq!(first, [0, 1]);
        // The third that was ordered waits for a thread, a fourth is ordered when the first was taken.
        (0..3).for_each(|_| key.send(()).unwrap());
        assert_eq!(loader.next().unwrap().index, 0);
        let mut next: Vec<u64> = (0..2).map(|_| questions.recv().unwrap()).collect();
        next.sort_unstable();
        assert_eq!(next, [2, 3]);
        // What still waits inside a window gets through; then the threads end and with them the source.
        drop(key);
        drop(loader);
        assert_eq!(questions.iter().count(), 0, "nothing was begun after the end");
    }
}
