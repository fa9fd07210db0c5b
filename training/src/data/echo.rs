//! Windows shown several times, for where making one costs more than training on it ("data echoing", Choi et al. 2019).

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use grnet_geometry::Pose;

use super::{DataError, Window, Windows};

/// Windows between two showings of the same one.
const APART: u64 = 256;

/// Shows every window of another source `times` times, 256 windows apart, every other time backwards.
///
/// Still a pure function of the index; what is kept in memory only saves making a window again.
pub struct Echoed {
    inner: Arc<dyn Windows>,
    times: u64,
    kept: Mutex<BTreeMap<u64, Arc<Window>>>,
}

impl Echoed {
    /// `times` showings of each window of `inner`; 1 changes nothing.
    pub fn new(inner: Arc<dyn Windows>, times: u64) -> Self {
        Self { inner, times: times.max(1), kept: Mutex::default() }
    }

    /// Which window is shown, and which showing it is.
    fn place(&self, index: u64) -> (u64, u64) {
        let round = index / APART;
        (round / self.times * APART + index % APART, round % self.times)
    }

    fn kept(&self, base: u64) -> Result<Arc<Window>, DataError> {
        let lock = || self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(window) = lock().get(&base) {
            return Ok(window.clone());
        }
        let window = Arc::new(self.inner.window(base)?);
        let mut kept = lock();
        // The block before may still be asked for by a slower thread; older ones are done with.
        let oldest = (base / APART).saturating_sub(1) * APART;
        *kept = kept.split_off(&oldest);
        kept.insert(base, window.clone());
        Ok(window)
    }
}

impl Windows for Echoed {
    fn k(&self) -> usize {
        self.inner.k()
    }

    fn window(&self, index: u64) -> Result<Window, DataError> {
        let (base, showing) = self.place(index);
        if self.times == 1 {
            return self.inner.window(base);
        }
        let window = self.kept(base)?;
        Ok(if showing % 2 == 1 { backwards(&window) } else { Window::clone(&window) })
    }

    fn poses(&self, index: u64) -> Result<Vec<Pose>, DataError> {
        let (base, showing) = self.place(index);
        let mut poses = self.inner.poses(base)?;
        if self.times > 1 && showing % 2 == 1 {
            poses.reverse();
        }
        Ok(poses)
    }

    fn size_px(&self) -> Option<(u32, u32)> {
        self.inner.size_px()
    }

    fn fingerprint(&self) -> String {
        format!("{} {} times", self.inner.fingerprint(), self.times)
    }

    fn describe(&self) -> String {
        format!("{}, each shown {} times", self.inner.describe(), self.times)
    }
}

fn backwards(window: &Window) -> Window {
    let frame = window.images.len() / window.world_from_camera.len().max(1);
    Window {
        images: window.images.chunks_exact(frame.max(1)).rev().flatten().copied().collect(),
        world_from_camera: window.world_from_camera.iter().rev().copied().collect(),
        name: format!("{} backwards", window.name),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicU64, Ordering};

    /// Two frames of two numbers each that tell the window's index.
    struct Numbered(AtomicU64);

    impl Windows for Numbered {
        fn k(&self) -> usize {
            2
        }

        fn window(&self, index: u64) -> Result<Window, DataError> {
            self.0.fetch_add(1, Ordering::Relaxed);
            let value = index as f32;
            Ok(Window {
                images: vec![value, 0.1, value, 0.2],
                world_from_camera: [1.0, 2.0].map(|x| Pose::translation(x, index as f64, 0.0)).to_vec(),
                name: index.to_string(),
            })
        }

        fn fingerprint(&self) -> String {
            "numbered".into()
        }

        fn describe(&self) -> String {
            "numbers".into()
        }
    }

    #[test]
    fn each_window_is_made_once_and_shown_forwards_and_backwards() {
        let echoed = Echoed::new(Arc::new(Numbered(AtomicU64::new(0))), 3);
        let shown: Vec<Window> = (0..6 * APART).map(|index| echoed.window(index).unwrap()).collect();
        let first = |index: u64| shown[index as usize].images[0];
        assert_eq!([first(5), first(APART + 5), first(2 * APART + 5)], [5.0; 3]);
        assert_eq!(first(3 * APART + 5), (APART + 5) as f32);
        assert_eq!(shown[5].images, [5.0, 0.1, 5.0, 0.2]);
        assert_eq!(shown[APART as usize + 5].images, [5.0, 0.2, 5.0, 0.1]);
        for (index, window) in shown.iter().enumerate() {
            assert_eq!(echoed.poses(index as u64).unwrap(), window.world_from_camera);
            assert_eq!(echoed.window(index as u64).unwrap(), *window, "also out of order");
        }
    }

    #[test]
    fn in_order_nothing_is_made_twice() {
        let made = Arc::new(Numbered(AtomicU64::new(0)));
        let echoed = Echoed::new(made.clone(), 4);
        (0..8 * APART).for_each(|index| drop(echoed.window(index).unwrap()));
        assert_eq!(made.0.load(Ordering::Relaxed), 2 * APART);
        assert!(echoed.kept.lock().unwrap().len() as u64 <= 2 * APART);
    }
}
