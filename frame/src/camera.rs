//! Pinhole intrinsics with distortion.

/// Lens distortion in the parametrisations that calibration tools write.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Distortion {
    /// An ideal pinhole.
    None,
    /// OpenCV / ROS `plumb_bob`: k1, k2, p1, p2, k3.
    PlumbBob([f64; 5]),
    /// Kannala-Brandt fisheye, OpenCV `fisheye`, ROS `equidistant`: k1, k2, k3, k4.
    Equidistant([f64; 4]),
}

/// Why intrinsics were refused.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CameraError {
    /// A value is not a finite number, or a focal length or size is not positive.
    #[error("camera {name} is {found}: {expected} expected")]
    Value {
        /// Which parameter.
        name: &'static str,
        /// What was found.
        found: f64,
        /// What it must be.
        expected: &'static str,
    },
}

/// Intrinsics of a camera at one image size: pixel centres at integer coordinates, x right, y down, z forward.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    width_px: u32,
    height_px: u32,
    fx_px: f64,
    fy_px: f64,
    cx_px: f64,
    cy_px: f64,
    distortion: Distortion,
}

impl Camera {
    /// Intrinsics for images of `width_px` x `height_px`; `focal_px` is (fx, fy), `centre_px` is (cx, cy).
    ///
    /// # Errors
    /// When a value is not finite, or a size or focal length is not positive.
    pub fn new(
        (width_px, height_px): (u32, u32),
        focal_px: (f64, f64),
        centre_px: (f64, f64),
        distortion: Distortion,
    ) -> Result<Self, CameraError> {
        let positive = |name, found: f64| {
            let ok = found.is_finite() && found > 0.0;
            if ok {
                Ok(found)
            } else {
                Err(CameraError::Value { name, found, expected: "a positive number" })
            }
        };
        let finite = |name, found: f64| {
            if found.is_finite() {
                Ok(found)
            } else {
                Err(CameraError::Value { name, found, expected: "a finite number" })
            }
        };
        positive("width", width_px.into())?;
        positive("height", height_px.into())?;
        let coefficients: &[f64] = match &distortion {
            Distortion::None => &[],
            Distortion::PlumbBob(k) => k,
            Distortion::Equidistant(k) => k,
        };
        for k in coefficients {
            finite("distortion coefficient", *k)?;
        }
        Ok(Self {
            width_px,
            height_px,
            fx_px: positive("fx", focal_px.0)?,
            fy_px: positive("fy", focal_px.1)?,
            cx_px: finite("cx", centre_px.0)?,
            cy_px: finite("cy", centre_px.1)?,
            distortion,
        })
    }

    /// Image size (width, height) in pixels that the intrinsics hold for.
    pub fn size_px(&self) -> (u32, u32) {
        (self.width_px, self.height_px)
    }

    /// Focal lengths (fx, fy) in pixels.
    pub fn focal_px(&self) -> (f64, f64) {
        (self.fx_px, self.fy_px)
    }

    /// Principal point (cx, cy) in pixels.
    pub fn centre_px(&self) -> (f64, f64) {
        (self.cx_px, self.cy_px)
    }

    /// Lens distortion.
    pub fn distortion(&self) -> Distortion {
        self.distortion
    }

    /// The same camera after its image was resized to `width_px` x `height_px` (pixel centres at integers:
    /// the edge of the image, not its first pixel's centre, stays in place).
    #[must_use]
    pub fn resized(&self, width_px: u32, height_px: u32) -> Self {
        let sx = f64::from(width_px) / f64::from(self.width_px);
        let sy = f64::from(height_px) / f64::from(self.height_px);
        Self {
            width_px,
            height_px,
            fx_px: self.fx_px * sx,
            fy_px: self.fy_px * sy,
            cx_px: (self.cx_px + 0.5) * sx - 0.5,
            cy_px: (self.cy_px + 0.5) * sy - 0.5,
            distortion: self.distortion,
        }
    }

    /// The same camera after its image was cut to the rectangle with corner (`x_px`, `y_px`).
    #[must_use]
    pub fn cropped(&self, x_px: u32, y_px: u32, width_px: u32, height_px: u32) -> Self {
        Self {
            width_px,
            height_px,
            cx_px: self.cx_px - f64::from(x_px),
            cy_px: self.cy_px - f64::from(y_px),
            ..*self
        }
    }

    /// The same camera without distortion: what holds after undistortion with unchanged intrinsics.
    #[must_use]
    pub fn undistorted(&self) -> Self {
        Self { distortion: Distortion::None, ..*self }
    }

    /// Applies the lens distortion: ideal normalised image coordinates (X/Z, Y/Z) to distorted ones.
    ///
    /// ```
    /// use grnet_frame::{Camera, Distortion};
    /// let camera = Camera::new((640, 480), (500., 500.), (320., 240.), Distortion::PlumbBob([0.1, 0., 0., 0., 0.]))?;
    /// let (x, _) = camera.distort((0.5, 0.0));
    /// assert!((x - 0.5 * (1.0 + 0.1 * 0.25)).abs() < 1e-12);
    /// # Ok::<(), grnet_frame::CameraError>(())
    /// ```
    pub fn distort(&self, (x, y): (f64, f64)) -> (f64, f64) {
        match self.distortion {
            Distortion::None => (x, y),
            Distortion::PlumbBob([k1, k2, p1, p2, k3]) => {
                let r2 = x * x + y * y;
                let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
                (
                    x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                    y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
                )
            }
            Distortion::Equidistant([k1, k2, k3, k4]) => {
                let r = x.hypot(y);
                if r < 1e-12 {
                    return (x, y);
                }
                let theta = r.atan();
                let t2 = theta * theta;
                let theta_d = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))));
                (x * theta_d / r, y * theta_d / r)
            }
        }
    }

    /// Projects ideal normalised image coordinates to the pixel where this camera sees them.
    pub fn pixel_from_normalised(&self, normalised: (f64, f64)) -> (f64, f64) {
        let (x, y) = self.distort(normalised);
        (self.fx_px * x + self.cx_px, self.fy_px * y + self.cy_px)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera(distortion: Distortion) -> Camera {
        Camera::new((640, 480), (525.0, 520.0), (319.5, 239.5), distortion).unwrap()
    }

    #[test]
    fn resizing_keeps_the_edges_in_place() {
        let half = camera(Distortion::None).resized(320, 240);
        assert_eq!((half.focal_px(), half.centre_px()), ((262.5, 260.0), (159.5, 119.5)));
    }

    #[test]
    fn cropping_moves_the_centre_only() {
        let cut = camera(Distortion::None).cropped(80, 0, 480, 480);
        assert_eq!(
            (cut.size_px(), cut.centre_px(), cut.focal_px()),
            ((480, 480), (239.5, 239.5), (525.0, 520.0))
        );
    }

    #[test]
    fn equidistant_without_coefficients_maps_radius_to_angle() {
        let (x, y) = camera(Distortion::Equidistant([0.0; 4])).distort((3.0, 4.0));
        assert!((x.hypot(y) - 5f64.atan()).abs() < 1e-12 && (y / x - 4.0 / 3.0).abs() < 1e-12);
    }

    #[test]
    fn nonsense_is_refused_by_name() {
        let error = Camera::new((640, 480), (-1.0, 1.0), (0.0, 0.0), Distortion::None).unwrap_err();
        assert_eq!(error.to_string(), "camera fx is -1: a positive number expected");
        assert!(Camera::new((640, 480), (1.0, 1.0), (f64::NAN, 0.0), Distortion::None).is_err());
        assert!(
            Camera::new((640, 480), (1.0, 1.0), (0.0, 0.0), Distortion::PlumbBob([f64::INFINITY; 5]))
                .is_err()
        );
    }
}
