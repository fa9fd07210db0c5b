//! What the network is trained on: windows of K neighbouring frames with their poses.
//!
//! | module | what it does |
//! |---|---|
//! | [`window`] | [`Window`], the trait [`Windows`], and how strides and starts are drawn |
//! | [`recorded`] | windows cut from a recording's training frames |
//! | [`rendered`] | windows rendered on the fly in [synthetic rooms](crate::synth) |
//! | [`mixed`] | several sources with weights |
//! | [`echo`] | windows shown several times |
//! | [`views`] | frames drawn from where the camera never was, by the depth that the recording shows |
//! | [`augment`] | colour, noise, blur, erasing, and camera rotations with the pose corrected |
//! | [`queue`] | [`Loader`]: worker threads that make batches ahead of the trainer, in order |
//! | [`statistics`] | poses without images, to learn means and scales from |
//!
//! A window is a pure function of its source and its index: there is no state that could differ after a resume, and
//! neither the number of threads nor the machine changes a bit (for recordings, as far as the locked versions of the image
//! decoder and the resizer do not, whose arithmetic is whole numbers). Random draws come from ChaCha with the seed as its
//! key and the index as its stream; curves and rotations use IEEE arithmetic and the `libm` crate only.

pub mod augment;
pub mod echo;
mod error;
mod fingerprint;
mod image;
pub mod mixed;
pub mod queue;
pub mod recorded;
pub mod rendered;
pub mod statistics;
pub mod views;
pub mod window;

pub use augment::{AugmentOptions, Border};
pub use echo::Echoed;
pub use error::{DataError, FrameError};
pub use mixed::Mixed;
pub use queue::{Batch, Loader};
pub use recorded::{RecordedOptions, RecordedWindows};
pub use rendered::{RenderedOptions, RenderedWindows};
pub use views::ViewOptions;
pub use window::{Window, WindowOptions, Windows};
