//! Frame to network input: decode -> undistort -> resize / crop -> normalise.

mod decode;
mod remap;
mod undistort;
mod view;

pub use decode::DecodeError;
pub use view::{Intrinsics, IntrinsicsError, IntrinsicsOptions, IntrinsicsPolicy};

use fast_image_resize::images::{Image, ImageRef};
use fast_image_resize::{FilterType, PixelType, ResizeAlg, ResizeError, ResizeOptions, Resizer};
use grnet_frame::{Camera, Frame};
use grnet_model::{Colour, Filter, Preprocessing};

use decode::{Decoder, RgbImage};
use remap::Remap;
use undistort::UndistortMap;
use view::View;

/// Why a frame gave no network input. The preprocessor is as good as before: the next frame may be fine.
#[derive(Debug, thiserror::Error)]
pub enum PreprocessError {
    /// The frame's bytes are no image.
    #[error(transparent)]
    Decode(#[from] DecodeError),
    /// The frame's camera is not the one that the network knows.
    #[error(transparent)]
    Intrinsics(#[from] IntrinsicsError),
    /// The image could not be resized.
    #[error("a {width_px}x{height_px} image cannot be resized to {to_width_px}x{to_height_px}: {reason}")]
    Resize {
        /// Width of the frame.
        width_px: u32,
        /// Height of the frame.
        height_px: u32,
        /// Width asked for.
        to_width_px: u32,
        /// Height asked for.
        to_height_px: u32,
        /// What the resizer found.
        reason: String,
    },
}

/// What a network expects of its input.
#[derive(Debug, Clone, PartialEq)]
pub struct InputSpec {
    /// Width and height of the input in pixels.
    pub size_px: (u32, u32),
    /// Resize policy, filter, mean and deviation of the training.
    pub preprocessing: Preprocessing,
    /// Intrinsics of the training's source images, where the checkpoint names them.
    pub trained_camera: Option<Camera>,
}

/// Turns frames into network inputs as the training did; keeps its buffers from frame to frame.
#[derive(Debug)]
pub struct Preprocessor {
    spec: InputSpec,
    options: IntrinsicsOptions,
    configured_camera: Option<Camera>,
    /// `(v / 255 - mean) / std` for each channel and byte.
    normalised: [[f32; 256]; 3],
    planned: Option<Planned>,
    decoder: Decoder,
    resizer: Resizer,
    raw: RgbImage,
    straight: RgbImage,
    resized: Vec<u8>,
    /// (3, height, width)
    tensor: Vec<f32>,
}

/// What holds as long as the frames keep their size and camera.
#[derive(Debug)]
struct Planned {
    size_px: (u32, u32),
    camera: Option<Camera>,
    view: View,
    straightening: Option<Straightening>,
}

/// How frames of a distorting lens become straight.
#[derive(Debug)]
enum Straightening {
    /// In one pass with the resize.
    Composed(Remap),
    /// Before it: frames that are too small for that.
    Whole(UndistortMap),
}

impl Preprocessor {
    /// A preprocessor for a network; `camera` overrides what the frames say about their intrinsics.
    ///
    /// # Errors
    /// When `camera` is given and does not fit the training's intrinsics.
    pub fn new(
        spec: InputSpec,
        options: IntrinsicsOptions,
        camera: Option<Camera>,
    ) -> Result<Self, IntrinsicsError> {
        // The planes are written in this order; another one has to be written otherwise.
        let Preprocessing { mean, std, colour: Colour::Rgb, .. } = spec.preprocessing;
        let normalised = std::array::from_fn(|channel| {
            std::array::from_fn(|byte| ((byte as f64 / 255.0 - mean[channel]) / std[channel]) as f32)
        });
        let mut this = Self {
            spec,
            options,
            configured_camera: camera,
            normalised,
            planned: None,
            decoder: Decoder::default(),
            resizer: Resizer::new(),
            raw: RgbImage::default(),
            straight: RgbImage::default(),
            resized: Vec::new(),
            tensor: Vec::new(),
        };
        if let Some(camera) = camera {
            this.plan(camera.size_px(), Some(camera))?;
        }
        Ok(this)
    }

    /// The network input of a frame: (3, height, width), R then G then B, mean removed.
    ///
    /// # Errors
    /// See [`PreprocessError`].
    pub fn run(&mut self, frame: &Frame) -> Result<&[f32], PreprocessError> {
        let size_px = (frame.pixels.width_px(), frame.pixels.height_px());
        self.plan(size_px, self.configured_camera.or(frame.camera))?;
        self.decoder.decode(&frame.pixels, &mut self.raw)?;
        let Some(Planned { view, straightening, .. }) = &mut self.planned else {
            unreachable!("planned above")
        };
        let image = match straightening {
            Some(Straightening::Composed(remap)) => {
                remap.apply(&self.raw, &mut self.resized);
                None
            }
            Some(Straightening::Whole(map)) => {
                map.apply(&self.raw, &mut self.straight);
                Some(&self.straight)
            }
            None => Some(&self.raw),
        };
        if let Some(image) = image {
            resize(&mut self.resizer, self.spec.preprocessing.filter, image, view, &mut self.resized)
                .map_err(|error| PreprocessError::Resize {
                    width_px: size_px.0,
                    height_px: size_px.1,
                    to_width_px: view.target[2],
                    to_height_px: view.target[3],
                    reason: error.to_string(),
                })?;
        }
        normalise(&self.resized, view, self.spec.size_px, &self.normalised, &mut self.tensor);
        Ok(&self.tensor)
    }

    /// Checks the intrinsics of frames to come, so that a wrong camera is refused before its first frame.
    ///
    /// # Errors
    /// When they do not fit those of the training, or those that were configured.
    pub fn check_camera(&self, camera: &Camera) -> Result<Intrinsics, IntrinsicsError> {
        let size_px = camera.size_px();
        Ok(self.view(size_px, self.configured_camera.or(Some(*camera)))?.intrinsics)
    }

    /// What is known about the intrinsics of the frames seen last.
    pub fn intrinsics(&self) -> Intrinsics {
        self.planned.as_ref().map_or(Intrinsics::NotSeen, |planned| planned.view.intrinsics)
    }

    /// What the network expects.
    pub fn spec(&self) -> &InputSpec {
        &self.spec
    }

    fn view(&self, size_px: (u32, u32), camera: Option<Camera>) -> Result<View, IntrinsicsError> {
        if let Some(camera) = camera
            && camera.size_px() != size_px
        {
            let (configured_width_px, configured_height_px) = camera.size_px();
            let (width_px, height_px) = size_px;
            return Err(IntrinsicsError::Size {
                configured_width_px,
                configured_height_px,
                width_px,
                height_px,
            });
        }
        let InputSpec { size_px: input_px, preprocessing, trained_camera } = &self.spec;
        View::plan(
            size_px,
            camera.as_ref(),
            trained_camera.as_ref(),
            *input_px,
            preprocessing.resize,
            &self.options,
        )
    }

    /// Makes `planned` hold for frames of this size and camera; the map of an unchanged camera is kept.
    fn plan(&mut self, size_px: (u32, u32), camera: Option<Camera>) -> Result<(), IntrinsicsError> {
        if self.planned.as_ref().is_some_and(|planned| (planned.size_px, planned.camera) == (size_px, camera))
        {
            return Ok(());
        }
        let view = self.view(size_px, camera)?;
        let map = camera.filter(|_| view.undistort).and_then(|camera| UndistortMap::new(&camera));
        let straightening = map.map(|map| {
            Remap::new(&map, &view, self.spec.preprocessing.filter)
                .map_or(Straightening::Whole(map), Straightening::Composed)
        });
        self.planned = Some(Planned { size_px, camera, view, straightening });
        Ok(())
    }
}

/// Resizes the view's source box to the size of its target rectangle.
fn resize(
    resizer: &mut Resizer,
    filter: Filter,
    image: &RgbImage,
    view: &View,
    resized: &mut Vec<u8>,
) -> Result<(), ResizeError> {
    let [left, top, width, height] = view.source;
    let [_, _, columns, rows] = view.target;
    resized.resize(columns as usize * rows as usize * 3, 0);
    let buffer = "the buffer has the size of its image";
    let source = ImageRef::new(image.width_px, image.height_px, &image.data, PixelType::U8x3).expect(buffer);
    let mut target = Image::from_slice_u8(columns, rows, resized, PixelType::U8x3).expect(buffer);
    let algorithm = match filter {
        Filter::Bilinear => ResizeAlg::Convolution(FilterType::Bilinear),
        Filter::Area => ResizeAlg::Convolution(FilterType::Box),
    };
    let options = ResizeOptions::new().resize_alg(algorithm).crop(left, top, width, height);
    resizer.resize(&source, &mut target, &options)
}

/// Interleaved bytes to planes of floats; what the view does not cover becomes 0, the mean colour.
fn normalise(
    resized: &[u8],
    view: &View,
    (width_px, height_px): (u32, u32),
    table: &[[f32; 256]; 3],
    tensor: &mut Vec<f32>,
) {
    let (width, height) = (width_px as usize, height_px as usize);
    let [left, top, columns, rows] = view.target.map(|x| x as usize);
    tensor.resize(3 * width * height, 0.0);
    if (columns, rows) != (width, height) {
        tensor.fill(0.0);
    }
    let (red, rest) = tensor.split_at_mut(width * height);
    let (green, blue) = rest.split_at_mut(width * height);
    for (y, row) in resized.chunks_exact(columns * 3).enumerate() {
        let at = (top + y) * width + left;
        let planes = red[at..][..columns].iter_mut().zip(&mut green[at..][..columns]).zip(&mut blue[at..]);
        for (rgb, ((r, g), b)) in row.chunks_exact(3).zip(planes) {
            *r = table[0][usize::from(rgb[0])];
            *g = table[1][usize::from(rgb[1])];
            *b = table[2][usize::from(rgb[2])];
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use grnet_frame::{CaptureTime, PixelFormat, Pixels};
    use grnet_model::ResizePolicy;

    use super::*;

    fn frame(width: u32, height: u32, rgb: Vec<u8>) -> Frame {
        Frame {
            pixels: Arc::new(Pixels::packed(PixelFormat::Rgb8, width, height, rgb).unwrap()),
            capture_time: CaptureTime::recorded(1),
            sequence: 0,
            camera: None,
        }
    }

    fn spec(size_px: (u32, u32), resize: ResizePolicy, filter: Filter) -> InputSpec {
        let preprocessing = Preprocessing {
            resize,
            filter,
            mean: [0.5, 0.25, 0.0],
            std: [0.5, 0.25, 2.0],
            ..Preprocessing::default()
        };
        InputSpec { size_px, preprocessing, trained_camera: None }
    }

    fn run(spec: InputSpec, frame: &Frame) -> Vec<f32> {
        let mut preprocessor = Preprocessor::new(spec, IntrinsicsOptions::default(), None).unwrap();
        preprocessor.run(frame).unwrap().to_vec()
    }

    #[test]
    fn a_box_filter_takes_means_and_the_planes_are_normalised() {
        // 4x2 -> 2x1: each output pixel is the mean of 2x2.
        let red = [0u8, 40, 100, 200, 20, 60, 100, 240];
        let rgb: Vec<u8> = red.iter().flat_map(|r| [*r, 255, 51]).collect();
        let tensor = run(spec((2, 1), ResizePolicy::Stretch, Filter::Area), &frame(4, 2, rgb));
        let r = |byte: f32| (byte / 255.0 - 0.5) / 0.5;
        let expected = [r(30.0), r(160.0), 3.0, 3.0, 0.1, 0.1];
        assert!(tensor.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{tensor:?} {expected:?}");
    }

    /// Golden: the antialiased bilinear filter (triangle of half-width `scale`), written out in f64 as
    /// Pillow and `torchvision` (`antialias=True`) define it.
    #[test]
    fn bilinear_equals_the_antialiased_triangle_filter() {
        let (w, h, out) = (37usize, 29usize, 11usize);
        let byte = |x: usize, y: usize, c: usize| ((x * 37 + y * 91 + c * 53 + x * y) % 256) as u8;
        let rgb: Vec<u8> =
            (0..h).flat_map(|y| (0..w).flat_map(move |x| (0..3).map(move |c| byte(x, y, c)))).collect();
        let tensor = run(
            spec((out as u32, out as u32), ResizePolicy::CropCentre, Filter::Bilinear),
            &frame(w as u32, h as u32, rgb),
        );
        // The centre 29x29 is kept.
        let scale = h as f64 / out as f64;
        let weights = |i: usize, offset: f64, n: usize| -> Vec<(usize, f64)> {
            let centre = offset + (i as f64 + 0.5) * scale;
            let taps: Vec<_> = (0..n)
                .map(|j| (j, (1.0 - ((j as f64 + 0.5 - centre) / scale).abs()).max(0.0)))
                .filter(|(_, weight)| *weight > 0.0)
                .collect();
            let sum: f64 = taps.iter().map(|(_, weight)| weight).sum();
            taps.into_iter().map(|(j, weight)| (j, weight / sum)).collect()
        };
        let mut worst = 0.0f64;
        for y in 0..out {
            for x in 0..out {
                for c in 0..3 {
                    let mut sum = 0.0;
                    for (sy, wy) in weights(y, 0.0, h) {
                        for (sx, wx) in weights(x, 4.0, w) {
                            sum += wx * wy * f64::from(byte(sx, sy, c));
                        }
                    }
                    let [mean, std] = [[0.5, 0.5], [0.25, 0.25], [0.0, 2.0]][c];
                    let expected = (sum / 255.0 - mean) / std;
                    let found = f64::from(tensor[(c * out + y) * out + x]);
                    worst = worst.max((found - expected).abs() * std * 255.0);
                }
            }
        }
        // Two passes, each rounded to a byte.
        assert!(worst < 1.5, "{worst} grey levels");
    }

    #[test]
    fn what_a_converted_frame_does_not_cover_is_the_mean_colour() {
        let camera = |f| Camera::new((8, 8), (f, f), (3.5, 3.5), grnet_frame::Distortion::None).unwrap();
        let mut spec = spec((8, 8), ResizePolicy::Stretch, Filter::Bilinear);
        spec.trained_camera = Some(camera(6.0));
        let options = IntrinsicsOptions { policy: IntrinsicsPolicy::Convert, ..IntrinsicsOptions::default() };
        let mut preprocessor = Preprocessor::new(spec, options, Some(camera(8.0))).unwrap();
        let tensor = preprocessor.run(&frame(8, 8, vec![255; 192])).unwrap().to_vec();
        let white = tensor[..64].chunks(8).map(|row| row.iter().map(|v| if *v == 1.0 { '#' } else { '.' }));
        let picture: Vec<String> = white.map(Iterator::collect).collect();
        let line = ".######.";
        assert_eq!(picture, ["........", line, line, line, line, line, line, "........"]);
        assert_eq!(preprocessor.intrinsics(), Intrinsics::Converted { covered: 36.0 / 64.0 });
        assert!(tensor[..8].iter().all(|v| *v == 0.0));
    }

    #[test]
    fn configured_intrinsics_of_another_size_are_refused() {
        let camera =
            Camera::new((640, 480), (500.0, 500.0), (320.0, 240.0), grnet_frame::Distortion::None).unwrap();
        let spec = spec((8, 8), ResizePolicy::Stretch, Filter::Bilinear);
        let mut preprocessor = Preprocessor::new(spec, IntrinsicsOptions::default(), Some(camera)).unwrap();
        let error = preprocessor.run(&frame(8, 8, vec![0; 192])).unwrap_err();
        assert!(
            error.to_string().starts_with("the configured camera is 640x480, the frame is 8x8"),
            "{error}"
        );
        assert!(preprocessor.check_camera(&camera.resized(320, 240)).is_err());
        assert_eq!(preprocessor.check_camera(&camera).unwrap(), Intrinsics::UnknownForModel);
    }
}
