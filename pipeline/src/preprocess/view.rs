//! Which part of a frame becomes the network's input, and what the intrinsics say about it.

use grnet_frame::{Camera, Distortion};
use grnet_model::ResizePolicy;

/// What to do when a frame's intrinsics differ from those that the network was trained with.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum IntrinsicsPolicy {
    /// Refuse the camera: poses from other intrinsics are wrong in scale and angle.
    #[default]
    Refuse,
    /// Crop and resize the (undistorted) frame so that it has the intrinsics of the training.
    Convert,
}

/// What is known about a camera against the camera of the training.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Intrinsics {
    /// No frame and no configured camera yet.
    #[default]
    NotSeen,
    /// The checkpoint names its intrinsics, the source and the configuration do not: nothing was checked.
    UnknownForFrame,
    /// The source's intrinsics are known, the checkpoint names none: nothing was checked.
    UnknownForModel,
    /// Nobody knows any intrinsics: nothing was checked.
    Unknown,
    /// They agree: no corner of the input image is seen more than this far from where the training saw it.
    Matching {
        /// Largest displacement in pixels of the network's input.
        displacement_px: f64,
    },
    /// They differed and the frame is cropped and resized to those of the training.
    Converted {
        /// Share of the network's input that the frame covers; the rest is filled with the mean colour.
        covered: f64,
    },
}

impl Intrinsics {
    /// Whether the intrinsics of the frames are known to be those of the training.
    pub fn is_checked(self) -> bool {
        matches!(self, Self::Matching { .. } | Self::Converted { .. })
    }
}

/// Why a camera was refused.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum IntrinsicsError {
    /// The configured intrinsics hold for another image size.
    #[error(
        "the configured camera is {configured_width_px}x{configured_height_px}, the frame is \
         {width_px}x{height_px}; give the intrinsics at the frame's size or set the source's size"
    )]
    Size {
        /// Width that the intrinsics hold for.
        configured_width_px: u32,
        /// Height that the intrinsics hold for.
        configured_height_px: u32,
        /// The frame's width.
        width_px: u32,
        /// The frame's height.
        height_px: u32,
    },
    /// The intrinsics differ from those of the training.
    #[error(
        "the camera (fx {fx_px:.1}, fy {fy_px:.1}, cx {cx_px:.1}, cy {cy_px:.1} at the network's input) differs \
         from the training's (fx {trained_fx_px:.1}, fy {trained_fy_px:.1}, cx {trained_cx_px:.1}, cy \
         {trained_cy_px:.1}) by {displacement_px:.1} px at a corner, {allowed_px:.1} px are allowed; set \
         intrinsics = \"convert\", correct the camera's calibration, or use a checkpoint of this camera"
    )]
    Mismatch {
        /// Focal length of the frame at the network's input.
        fx_px: f64,
        /// Focal length of the frame at the network's input.
        fy_px: f64,
        /// Principal point of the frame at the network's input.
        cx_px: f64,
        /// Principal point of the frame at the network's input.
        cy_px: f64,
        /// Focal length of the training.
        trained_fx_px: f64,
        /// Focal length of the training.
        trained_fy_px: f64,
        /// Principal point of the training.
        trained_cx_px: f64,
        /// Principal point of the training.
        trained_cy_px: f64,
        /// Largest displacement of a corner.
        displacement_px: f64,
        /// Tolerance.
        allowed_px: f64,
    },
    /// The network was trained on images with another lens distortion.
    #[error(
        "the network was trained on images with distortion {trained:?}, the camera has {found:?}: one cannot be \
         made from the other here; use a checkpoint that was trained on undistorted images"
    )]
    Distortion {
        /// Distortion of the training.
        trained: Distortion,
        /// Distortion of the camera.
        found: Distortion,
    },
    /// After conversion too little of the network's input would be filled.
    #[error(
        "converted to the training's intrinsics the frame covers {:.0} % of the network's input, at least {:.0} % \
         are needed: the camera's field of view is too narrow for this checkpoint",
        covered * 100.0,
        needed * 100.0
    )]
    Coverage {
        /// Share covered.
        covered: f64,
        /// Share needed.
        needed: f64,
    },
}

/// How the intrinsics are to be treated.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct IntrinsicsOptions {
    /// What to do about a mismatch.
    pub policy: IntrinsicsPolicy,
    /// Largest displacement of a corner of the input image that counts as equal, as a share of its width.
    pub tolerance: f64,
    /// Least share of the network's input that a converted frame has to fill.
    pub least_coverage: f64,
    /// Undistort frames whose distortion is known (the network's training intrinsics decide where they are
    /// known: a network that was trained on the same distortion gets the frames as they are).
    pub undistort: bool,
}

impl Default for IntrinsicsOptions {
    fn default() -> Self {
        Self { policy: IntrinsicsPolicy::Refuse, tolerance: 0.01, least_coverage: 0.5, undistort: true }
    }
}

/// The part of the (undistorted) source that is resized into a rectangle of the network's input.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct View {
    /// Left, top, width, height in the source, in pixels from its upper left edge.
    pub(crate) source: [f64; 4],
    /// Left, top, width, height in the network's input.
    pub(crate) target: [u32; 4],
    pub(crate) undistort: bool,
    pub(crate) intrinsics: Intrinsics,
}

impl View {
    /// Plans the view of frames of `size_px` from `camera` for a network of `input_px` trained with `trained`.
    ///
    /// `trained` holds before the resize policy was applied, at the size of the training's source images.
    pub(crate) fn plan(
        size_px: (u32, u32),
        camera: Option<&Camera>,
        trained: Option<&Camera>,
        input_px: (u32, u32),
        resize: ResizePolicy,
        options: &IntrinsicsOptions,
    ) -> Result<Self, IntrinsicsError> {
        let whole = [0, 0, input_px.0, input_px.1];
        let unchecked = |undistort, intrinsics| {
            let source = policy_box(resize, size_px, input_px);
            Self { source, target: whole, undistort, intrinsics }
        };
        let is_distorted = |camera: &Camera| camera.distortion() != Distortion::None;
        let (camera, trained) = match (camera, trained) {
            (None, None) => return Ok(unchecked(false, Intrinsics::Unknown)),
            (None, Some(_)) => return Ok(unchecked(false, Intrinsics::UnknownForFrame)),
            (Some(camera), None) => {
                let undistort = options.undistort && is_distorted(camera);
                return Ok(unchecked(undistort, Intrinsics::UnknownForModel));
            }
            (Some(camera), Some(trained)) => (camera, trained),
        };
        let undistort = if !is_distorted(trained) {
            options.undistort && is_distorted(camera)
        } else if trained.distortion() == camera.distortion() {
            false
        } else {
            let (trained, found) = (trained.distortion(), camera.distortion());
            return Err(IntrinsicsError::Distortion { trained, found });
        };
        if !is_distorted(trained) && is_distorted(camera) && !undistort {
            let (trained, found) = (trained.distortion(), camera.distortion());
            return Err(IntrinsicsError::Distortion { trained, found });
        }
        let trained_at_input = at_input(trained, resize, input_px);
        let found_at_input = at_input(camera, resize, input_px);
        let displacement_px = corner_displacement_px(&found_at_input, &trained_at_input, input_px);
        let allowed_px = options.tolerance * f64::from(input_px.0);
        if displacement_px <= allowed_px {
            return Ok(unchecked(undistort, Intrinsics::Matching { displacement_px }));
        }
        match options.policy {
            // A crop and a resize move the centre of a distortion only together with fx and cx, so here too the
            // relation between the two images is one scale and one shift per axis.
            IntrinsicsPolicy::Refuse => {
                Err(mismatch(&found_at_input, &trained_at_input, displacement_px, allowed_px))
            }
            IntrinsicsPolicy::Convert => {
                let (source, target, covered) = converted(camera, &trained_at_input, input_px);
                if covered < options.least_coverage {
                    return Err(IntrinsicsError::Coverage { covered, needed: options.least_coverage });
                }
                Ok(Self { source, target, undistort, intrinsics: Intrinsics::Converted { covered } })
            }
        }
    }
}

/// Left, top, width, height of the part of a source image that the resize policy keeps.
fn policy_box(resize: ResizePolicy, size_px: (u32, u32), input_px: (u32, u32)) -> [f64; 4] {
    let (width, height) = (f64::from(size_px.0), f64::from(size_px.1));
    match resize {
        ResizePolicy::Stretch => [0.0, 0.0, width, height],
        ResizePolicy::CropCentre => {
            let aspect = f64::from(input_px.0) / f64::from(input_px.1);
            let (w, h) = (width.min(height * aspect), height.min(width / aspect));
            [(width - w) / 2.0, (height - h) / 2.0, w, h]
        }
    }
}

/// (fx, fy, cx, cy) in pixels.
type Pinhole = [f64; 4];

fn pinhole(camera: &Camera) -> Pinhole {
    let ((fx, fy), (cx, cy)) = (camera.focal_px(), camera.centre_px());
    [fx, fy, cx, cy]
}

/// The intrinsics after the resize policy. The box may be fractional, which `Camera::cropped` is not.
fn at_input(camera: &Camera, resize: ResizePolicy, input_px: (u32, u32)) -> Pinhole {
    let [left, top, width, height] = policy_box(resize, camera.size_px(), input_px);
    let (sx, sy) = (f64::from(input_px.0) / width, f64::from(input_px.1) / height);
    let [fx, fy, cx, cy] = pinhole(camera);
    [fx * sx, fy * sy, (cx + 0.5 - left) * sx - 0.5, (cy + 0.5 - top) * sy - 0.5]
}

/// Largest distance between where two cameras see the rays through the corners of `b`'s image.
fn corner_displacement_px(a: &Pinhole, b: &Pinhole, input_px: (u32, u32)) -> f64 {
    let [afx, afy, acx, acy] = *a;
    let [bfx, bfy, bcx, bcy] = *b;
    let (right, bottom) = (f64::from(input_px.0) - 0.5, f64::from(input_px.1) - 0.5);
    let displacement = |(u, v): (f64, f64)| {
        let (x, y) = ((u - bcx) / bfx, (v - bcy) / bfy);
        (afx * x + acx - u).hypot(afy * y + acy - v)
    };
    [(-0.5, -0.5), (right, -0.5), (-0.5, bottom), (right, bottom)]
        .map(displacement)
        .into_iter()
        .fold(0.0, f64::max)
}

fn mismatch(found: &Pinhole, trained: &Pinhole, displacement_px: f64, allowed_px: f64) -> IntrinsicsError {
    IntrinsicsError::Mismatch {
        fx_px: found[0],
        fy_px: found[1],
        cx_px: found[2],
        cy_px: found[3],
        trained_fx_px: trained[0],
        trained_fy_px: trained[1],
        trained_cx_px: trained[2],
        trained_cy_px: trained[3],
        displacement_px,
        allowed_px,
    }
}

/// The source box and the target rectangle that give the frame the training's intrinsics, and the share of
/// the input that the rectangle covers. Both cameras are pinholes with parallel axes, so a ray's pixels are
/// related by one scale and one shift per axis: `u_source = (u_input - cx_trained) fx / fx_trained + cx`.
fn converted(camera: &Camera, trained: &Pinhole, input_px: (u32, u32)) -> ([f64; 4], [u32; 4], f64) {
    let [fx, fy, cx, cy] = pinhole(camera);
    let [trained_fx, trained_fy, trained_cx, trained_cy] = *trained;
    let (width, height) = camera.size_px();
    let (left, columns, x) = overlap((fx / trained_fx, cx, trained_cx), width, input_px.0);
    let (top, rows, y) = overlap((fy / trained_fy, cy, trained_cy), height, input_px.1);
    let covered = f64::from(columns) * f64::from(rows) / (f64::from(input_px.0) * f64::from(input_px.1));
    ([x.0, y.0, x.1, y.1], [left, top, columns, rows], covered)
}

/// Along one axis: the first input pixel and the number of input pixels that lie wholly inside the source,
/// and the start and length of the source that they show.
fn overlap(
    (scale, centre_px, trained_centre_px): (f64, f64, f64),
    source_px: u32,
    input_px: u32,
) -> (u32, u32, (f64, f64)) {
    // Edge coordinates: input pixel i shows the source from `start + i scale` to `start + (i + 1) scale`.
    let start = (-0.5 - trained_centre_px) * scale + centre_px + 0.5;
    const ROUNDING: f64 = 1e-6;
    let first = ((0.0 - start) / scale - ROUNDING).ceil().clamp(0.0, f64::from(input_px));
    let end = ((f64::from(source_px) - start) / scale + ROUNDING).floor().clamp(0.0, f64::from(input_px));
    let count = (end - first).max(0.0);
    let source_start = (start + first * scale).clamp(0.0, f64::from(source_px));
    let source_length = (count * scale).min(f64::from(source_px) - source_start);
    (first as u32, count as u32, (source_start, source_length))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera(focal_px: f64) -> Camera {
        Camera::new((640, 480), (focal_px, focal_px), (319.5, 239.5), Distortion::None).unwrap()
    }

    fn plan(
        camera: Option<&Camera>,
        trained: Option<&Camera>,
        policy: IntrinsicsPolicy,
    ) -> Result<View, IntrinsicsError> {
        let options = IntrinsicsOptions { policy, ..IntrinsicsOptions::default() };
        View::plan((640, 480), camera, trained, (224, 224), ResizePolicy::CropCentre, &options)
    }

    #[test]
    fn the_policy_keeps_all_or_the_centre() {
        assert_eq!(policy_box(ResizePolicy::Stretch, (640, 480), (224, 224)), [0.0, 0.0, 640.0, 480.0]);
        assert_eq!(policy_box(ResizePolicy::CropCentre, (640, 480), (224, 224)), [80.0, 0.0, 480.0, 480.0]);
        assert_eq!(policy_box(ResizePolicy::CropCentre, (480, 640), (200, 100)), [0.0, 200.0, 480.0, 240.0]);
    }

    #[test]
    fn an_unknown_side_is_said_to_be_unknown() {
        let known = camera(525.0);
        let state = |a, b| plan(a, b, IntrinsicsPolicy::Refuse).unwrap().intrinsics;
        assert_eq!(state(None, None), Intrinsics::Unknown);
        assert_eq!(state(Some(&known), None), Intrinsics::UnknownForModel);
        assert_eq!(state(None, Some(&known)), Intrinsics::UnknownForFrame);
        assert_eq!(state(Some(&known), Some(&known)), Intrinsics::Matching { displacement_px: 0.0 });
        assert!(!Intrinsics::UnknownForModel.is_checked());
    }

    #[test]
    fn the_same_lens_at_another_size_matches() {
        let view = View::plan(
            (320, 240),
            Some(&camera(525.0).resized(320, 240)),
            Some(&camera(525.0)),
            (224, 224),
            ResizePolicy::CropCentre,
            &IntrinsicsOptions::default(),
        );
        let Intrinsics::Matching { displacement_px } = view.unwrap().intrinsics else { panic!("no match") };
        assert!(displacement_px < 1e-9);
    }

    #[test]
    fn another_focal_length_is_refused_or_converted() {
        let error = plan(Some(&camera(585.0)), Some(&camera(525.0)), IntrinsicsPolicy::Refuse).unwrap_err();
        assert!(matches!(error, IntrinsicsError::Mismatch { .. }), "{error}");
        assert!(error.to_string().contains("fx 273.0") && error.to_string().contains("fx 245.0"), "{error}");

        // A wider lens than the training's: a smaller part of the frame fills the whole input.
        let view = plan(Some(&camera(525.0)), Some(&camera(600.0)), IntrinsicsPolicy::Convert).unwrap();
        let side = 480.0 * 525.0 / 600.0;
        let expected = [320.0 - side / 2.0, 240.0 - side / 2.0, side, side];
        assert!(view.source.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-9), "{view:?}");
        assert_eq!(
            (view.target, view.intrinsics),
            ([0, 0, 224, 224], Intrinsics::Converted { covered: 1.0 })
        );

        // A narrower lens: rows are missing above and below, columns are not (the frame is wider than high).
        let view = plan(Some(&camera(600.0)), Some(&camera(525.0)), IntrinsicsPolicy::Convert).unwrap();
        assert_eq!(view.target, [0, 14, 224, 196]);
        let error = plan(Some(&camera(1500.0)), Some(&camera(500.0)), IntrinsicsPolicy::Convert).unwrap_err();
        assert!(matches!(error, IntrinsicsError::Coverage { .. }), "{error}");
    }

    #[test]
    fn a_converted_view_has_the_trainings_intrinsics() {
        let found = Camera::new((800, 600), (611.0, 605.0), (390.0, 310.0), Distortion::None).unwrap();
        let trained = Camera::new((640, 480), (525.0, 520.0), (322.0, 236.0), Distortion::None).unwrap();
        let options = IntrinsicsOptions { policy: IntrinsicsPolicy::Convert, ..IntrinsicsOptions::default() };
        let view =
            View::plan((800, 600), Some(&found), Some(&trained), (224, 160), ResizePolicy::Stretch, &options)
                .unwrap();
        let [left, top, width, height] = view.source;
        let [x, y, columns, rows] = view.target.map(f64::from);
        let (sx, sy) = (columns / width, rows / height);
        let after = [
            found.focal_px().0 * sx,
            found.focal_px().1 * sy,
            (found.centre_px().0 + 0.5 - left) * sx - 0.5 + x,
            (found.centre_px().1 + 0.5 - top) * sy - 0.5 + y,
        ];
        let expected = trained.resized(224, 160);
        let expected = pinhole(&expected);
        assert!(after.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{after:?} {expected:?}");
    }

    #[test]
    fn distortion_is_removed_kept_or_refused() {
        let fisheye = |k| {
            Camera::new((640, 480), (525.0, 525.0), (319.5, 239.5), Distortion::Equidistant([k, 0., 0., 0.]))
                .unwrap()
        };
        let (ideal, a, b) = (camera(525.0), fisheye(0.1), fisheye(0.2));
        let undistort = |found, trained| plan(Some(found), Some(trained), IntrinsicsPolicy::Refuse);
        assert!(undistort(&a, &ideal).unwrap().undistort);
        assert!(!undistort(&a, &a).unwrap().undistort);
        assert!(matches!(undistort(&b, &a), Err(IntrinsicsError::Distortion { .. })));
        assert!(matches!(undistort(&ideal, &a), Err(IntrinsicsError::Distortion { .. })));
        let options = IntrinsicsOptions { undistort: false, ..IntrinsicsOptions::default() };
        let kept =
            View::plan((640, 480), Some(&a), Some(&ideal), (224, 224), ResizePolicy::Stretch, &options);
        assert!(matches!(kept, Err(IntrinsicsError::Distortion { .. })));
    }
}
