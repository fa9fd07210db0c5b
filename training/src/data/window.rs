//! Windows, where they come from, and how strides and starts are drawn.

use grnet_geometry::Pose;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::DataError;

/// K frames with their poses, ready for the network.
#[derive(Debug, Clone, PartialEq)]
pub struct Window {
    /// (K, 3, H, W): normalised as the checkpoint's `Preprocessing` says.
    pub images: Vec<f32>,
    /// Pose of the camera at each of the K frames, metres.
    pub world_from_camera: Vec<Pose>,
    /// For errors: room or sequence, and frame numbers.
    pub name: String,
}

/// Where windows come from: a pure function of the index.
///
/// The same source and index give the same window on every machine and thread; that is what makes resume exact.
pub trait Windows: Send + Sync {
    /// Frames in a window.
    fn k(&self) -> usize;

    /// Window number `index`; there is no last one.
    ///
    /// # Errors
    /// When an image cannot be read, decoded or rendered.
    fn window(&self, index: u64) -> Result<Window, DataError>;

    /// The poses of window `index` alone, which most sources know without making its images.
    ///
    /// # Errors
    /// As [`Windows::window`].
    fn poses(&self, index: u64) -> Result<Vec<Pose>, DataError> {
        Ok(self.window(index)?.world_from_camera)
    }

    /// Width and height of the images; `None`: they are square.
    fn size_px(&self) -> Option<(u32, u32)> {
        None
    }

    /// Hash of everything that determines the windows: files, sizes, poses, options.
    fn fingerprint(&self) -> String;

    /// One line for a log.
    fn describe(&self) -> String;
}

/// Which frames make a window.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WindowOptions {
    /// Frames in a window; 1 gives single frames.
    pub k: usize,
    /// Frames from one frame of a window to the next; one of them is drawn for each window. Where a run of
    /// neighbours is too short for the stride drawn, the longest that fits is taken.
    pub strides: Vec<u32>,
    /// How often each stride is drawn, relative to the others; empty: equally often.
    pub stride_weights: Vec<f64>,
    /// Draw a stride for each step of a window instead of one for all of them: RCNN1 meets the uneven pairs that key frames
    /// (and dropped frames) bring at run time.
    pub uneven: bool,
    /// Share of windows that are played backwards, poses included.
    pub reverse_share: f64,
    /// Seed of every draw.
    pub seed: u64,
}

impl Default for WindowOptions {
    /// Windows of 5 frames as in the paper, at strides 1, 2, 3, 5 and 8, half of them backwards.
    fn default() -> Self {
        Self {
            k: 5,
            strides: vec![1, 2, 3, 5, 8],
            stride_weights: Vec::new(),
            uneven: false,
            reverse_share: 0.5,
            seed: 0,
        }
    }
}

impl WindowOptions {
    pub(crate) fn check(&self) -> Result<(), DataError> {
        if self.k == 0 || self.k > 1000 {
            return Err(DataError::option("k", self.k, "1 to 1000 frames"));
        }
        if self.strides.is_empty() || self.strides.iter().any(|s| !(1..=10_000).contains(s)) {
            let found = format!("{:?}", self.strides);
            return Err(DataError::option("strides", found, "at least one number from 1 to 10000"));
        }
        if !self.stride_weights.is_empty() {
            check_weights("stride_weights", &self.stride_weights, self.strides.len())?;
        }
        check_share("reverse_share", self.reverse_share)
    }

    /// Where the frames of a window lie, counted from its first one, as `rng` draws; no step is longer than `longest`.
    pub(crate) fn draw_offsets(&self, longest: Option<u32>, rng: &mut ChaCha8Rng) -> Vec<u32> {
        let fitting = |stride: u32| longest.map_or(stride, |longest| stride.min(longest));
        let first = fitting(self.draw_stride(rng));
        let mut offset = 0;
        let mut offsets = vec![offset];
        for step in 1..self.k {
            offset += if self.uneven && step > 1 { fitting(self.draw_stride(rng)) } else { first };
            offsets.push(offset);
        }
        offsets
    }

    fn draw_stride(&self, rng: &mut ChaCha8Rng) -> u32 {
        if self.stride_weights.is_empty() {
            return self.strides[rng.random_range(0..self.strides.len())];
        }
        self.strides[draw_weighted(&self.stride_weights, rng)]
    }
}

/// What a draw is for: the same seed and index give independent numbers for each.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Purpose {
    /// Which frames or poses.
    Choice = 1,
    /// Augmentation.
    Augment = 2,
    /// Which source.
    Mix = 3,
    /// Where the camera is moved to.
    View = 4,
}

/// The random numbers of window `index`.
pub(crate) fn generator(seed: u64, purpose: Purpose, index: u64) -> ChaCha8Rng {
    let mut key = [0; 32];
    key[..8].copy_from_slice(&seed.to_le_bytes());
    key[8] = purpose as u8;
    key[16..].copy_from_slice(b"grnet-train data");
    let mut rng = ChaCha8Rng::from_seed(key);
    rng.set_stream(index);
    rng
}

/// An index drawn with the given weights, which are not negative and not all 0.
pub(crate) fn draw_weighted(weights: &[f64], rng: &mut ChaCha8Rng) -> usize {
    let mut left = rng.random::<f64>() * weights.iter().sum::<f64>();
    for (index, weight) in weights.iter().enumerate() {
        left -= weight;
        if left < 0.0 {
            return index;
        }
    }
    // Rounding may leave a trifle: the last one that can be drawn at all.
    weights.iter().rposition(|weight| *weight > 0.0).unwrap_or(0)
}

pub(crate) fn check_weights(option: &'static str, weights: &[f64], count: usize) -> Result<(), DataError> {
    let usable = weights.iter().all(|w| w.is_finite() && *w >= 0.0) && weights.iter().any(|w| *w > 0.0);
    if usable && weights.len() == count {
        return Ok(());
    }
    let expected = format!("{count} numbers, none negative and not all 0");
    Err(DataError::option(option, format!("{weights:?}"), expected))
}

pub(crate) fn check_share(option: &'static str, share: f64) -> Result<(), DataError> {
    if (0.0..=1.0).contains(&share) { Ok(()) } else { Err(DataError::option(option, share, "0 to 1")) }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Windows of one pixel a frame that hold their own index and a tag.
    #[derive(Debug, Clone, Default)]
    pub struct Counting {
        pub k: usize,
        pub tag: f32,
        /// Windows that cannot be made.
        pub broken: Vec<u64>,
        /// Windows that panic.
        pub faulty: Vec<u64>,
    }

    impl Windows for Counting {
        fn k(&self) -> usize {
            self.k
        }

        fn window(&self, index: u64) -> Result<Window, DataError> {
            assert!(!self.faulty.contains(&index), "window {index} is faulty");
            if self.broken.contains(&index) {
                return Err(DataError::option("broken", index, "another window"));
            }
            let images = (0..self.k).flat_map(|_| [index as f32, self.tag, 0.0]).collect();
            Ok(Window { images, world_from_camera: vec![Pose::identity(); self.k], name: index.to_string() })
        }

        fn fingerprint(&self) -> String {
            format!("counting {} {}", self.k, self.tag)
        }

        fn describe(&self) -> String {
            "counting".into()
        }
    }

    #[test]
    fn strides_are_drawn_as_often_as_their_weights_say() {
        let mut options = WindowOptions { strides: vec![1, 2, 4], ..WindowOptions::default() };
        let counts = |options: &WindowOptions| {
            let mut counts = [0usize; 5];
            for index in 0..30_000 {
                counts[options.draw_stride(&mut generator(7, Purpose::Choice, index)) as usize] += 1;
            }
            counts
        };
        let even = counts(&options);
        assert!([1, 2, 4].iter().all(|s| (9_600..10_400).contains(&even[*s])), "{even:?}");
        options.stride_weights = vec![1.0, 0.0, 3.0];
        let weighed = counts(&options);
        assert_eq!(weighed[2], 0);
        assert!((7_200..7_800).contains(&weighed[1]), "{weighed:?}");
    }

    #[test]
    fn uneven_windows_draw_every_step_and_even_ones_only_the_first() {
        let even = WindowOptions { k: 6, strides: vec![1, 2, 5], ..WindowOptions::default() };
        let uneven = WindowOptions { uneven: true, ..even.clone() };
        let mut seen = std::collections::BTreeSet::new();
        for index in 0..200 {
            let steps = |options: &WindowOptions, longest| {
                let offsets = options.draw_offsets(longest, &mut generator(7, Purpose::Choice, index));
                assert_eq!((offsets.len(), offsets[0]), (6, 0));
                offsets.windows(2).map(|pair| pair[1] - pair[0]).collect::<Vec<_>>()
            };
            let one = steps(&even, None);
            assert!(one.iter().all(|step| *step == one[0]), "{one:?}");
            let many = steps(&uneven, None);
            assert_eq!(many[0], one[0], "the first step is the same draw");
            assert!(many.iter().all(|step| [1, 2, 5].contains(step)));
            seen.insert(many);
            assert!(steps(&uneven, Some(2)).iter().all(|step| [1, 2].contains(step)));
        }
        assert!(seen.len() > 100, "{} of 200 windows differ", seen.len());
        let single = WindowOptions { k: 1, ..uneven };
        assert_eq!(single.draw_offsets(Some(3), &mut generator(7, Purpose::Choice, 0)), [0]);
    }

    #[test]
    fn purposes_seeds_and_indices_have_numbers_of_their_own() {
        let first = |seed, purpose, index| generator(seed, purpose, index).random::<u64>();
        let all = [
            first(0, Purpose::Choice, 0),
            first(0, Purpose::Augment, 0),
            first(0, Purpose::Mix, 0),
            first(1, Purpose::Choice, 0),
            first(0, Purpose::Choice, 1),
        ];
        assert!((0..5).all(|i| (0..i).all(|j| all[i] != all[j])), "{all:?}");
        assert_eq!(first(0, Purpose::Choice, 0), all[0]);
    }

    #[test]
    fn senseless_options_are_named() {
        let problem = |change: &dyn Fn(&mut WindowOptions)| {
            let mut options = WindowOptions::default();
            change(&mut options);
            options.check().unwrap_err().to_string()
        };
        assert_eq!(
            problem(&|o| o.k = 0),
            "option `k` of the training data: found 0, expected 1 to 1000 frames"
        );
        assert!(problem(&|o| o.strides = vec![]).contains("`strides`"));
        assert!(problem(&|o| o.strides = vec![0]).contains("`strides`"));
        assert!(problem(&|o| o.stride_weights = vec![1.0]).contains("expected 5 numbers"));
        assert!(problem(&|o| o.stride_weights = vec![0.0; 5]).contains("not all 0"));
        assert!(problem(&|o| o.reverse_share = f64::NAN).contains("`reverse_share`"));
        WindowOptions::default().check().unwrap();
    }
}
