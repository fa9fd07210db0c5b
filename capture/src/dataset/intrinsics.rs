//! Intrinsics as datasets give them: often without the image size that they hold for.

use std::path::Path;

use grnet_frame::{Camera, CameraError, Distortion};

use super::DatasetError;
use super::text::TextFile;

/// Pinhole parameters whose image size may have to come from the images.
#[derive(Debug, Clone)]
pub(crate) struct Intrinsics {
    pub focal_px: (f64, f64),
    /// `None`: the middle of the image.
    pub centre_px: Option<(f64, f64)>,
    pub distortion: Distortion,
    pub size_px: Option<(u32, u32)>,
    /// Published figures that may be scaled to the stored size, rather than a calibration of these images.
    pub scalable: bool,
    /// Where they come from, for errors.
    pub origin: String,
}

impl Intrinsics {
    pub fn of(camera: &Camera, origin: impl Into<String>) -> Self {
        Self {
            focal_px: camera.focal_px(),
            centre_px: Some(camera.centre_px()),
            distortion: camera.distortion(),
            size_px: Some(camera.size_px()),
            scalable: false,
            origin: origin.into(),
        }
    }

    /// A focal length alone: square pixels, the centre in the middle.
    pub fn with_focal(focal_px: f64, origin: impl Into<String>) -> Self {
        Self {
            focal_px: (focal_px, focal_px),
            centre_px: None,
            distortion: Distortion::None,
            size_px: None,
            scalable: false,
            origin: origin.into(),
        }
    }

    /// The camera for images of the given size; `None` when no size is known.
    pub fn camera(&self, image: Option<(&Path, (u32, u32))>) -> Result<Option<Camera>, DatasetError> {
        let Some(size_px) = self.size_px.or(image.map(|(_, size)| size)) else {
            return Ok(None);
        };
        // Pixel centres lie at integers, so the middle of w pixels is (w - 1) / 2.
        let middle = (f64::from(size_px.0 - 1) / 2.0, f64::from(size_px.1 - 1) / 2.0);
        let camera = Camera::new(size_px, self.focal_px, self.centre_px.unwrap_or(middle), self.distortion)
            .map_err(|error: CameraError| DatasetError::Option {
            option: "camera",
            problem: format!("{}: {error}", self.origin),
        })?;
        match image {
            Some((path, (image_width_px, image_height_px)))
                if (image_width_px, image_height_px) != size_px =>
            {
                if self.scalable {
                    return Ok(Some(camera.resized(image_width_px, image_height_px)));
                }
                Err(DatasetError::CameraSize {
                    origin: self.origin.clone(),
                    camera_width_px: size_px.0,
                    camera_height_px: size_px.1,
                    image: path.to_path_buf(),
                    image_width_px,
                    image_height_px,
                })
            }
            _ => Ok(Some(camera)),
        }
    }
}

/// Reads `camera-intrinsics.txt`, three rows of a 3x3 camera matrix, and `camera-distortion.txt` beside it, where
/// there is one.
pub(crate) fn read_matrix(path: &Path) -> Result<Option<Intrinsics>, DatasetError> {
    let Some(file) = TextFile::read_if_present(path)? else { return Ok(None) };
    let mut intrinsics = parse_matrix(&file)?;
    if let Some(file) = TextFile::read_if_present(&path.with_file_name("camera-distortion.txt"))? {
        intrinsics.distortion = parse_distortion(&file)?;
    }
    Ok(Some(intrinsics))
}

/// One line: the model and its coefficients.
fn parse_distortion(file: &TextFile) -> Result<Distortion, DatasetError> {
    let expected = "one line `none`, `plumb_bob k1 k2 p1 p2 k3` or `equidistant k1 k2 k3 k4`";
    let mut lines = file.data_lines();
    let line = lines.next().unwrap_or_else(|| file.end());
    let coefficients = |fields: &[&str]| -> Result<Vec<f64>, DatasetError> {
        fields.iter().map(|field| line.finite(field, expected)).collect()
    };
    let distortion = match line.fields().as_slice() {
        ["none"] => Distortion::None,
        ["plumb_bob", fields @ ..] if fields.len() == 5 => {
            let k = coefficients(fields)?;
            Distortion::PlumbBob(std::array::from_fn(|i| k[i]))
        }
        ["equidistant", fields @ ..] if fields.len() == 4 => {
            let k = coefficients(fields)?;
            Distortion::Equidistant(std::array::from_fn(|i| k[i]))
        }
        _ => return Err(line.unexpected(expected)),
    };
    match lines.next() {
        Some(line) => Err(line.unexpected("the end of the file after one line")),
        None => Ok(distortion),
    }
}

pub(crate) fn parse_matrix(file: &TextFile) -> Result<Intrinsics, DatasetError> {
    let expected = "three rows of the camera matrix: fx 0 cx / 0 fy cy / 0 0 1";
    let mut lines = file.data_lines();
    let mut rows = [[0.0; 3]; 3];
    for (index, row) in rows.iter_mut().enumerate() {
        let line = lines.next().unwrap_or_else(|| file.end());
        if line.text.is_empty() {
            return Err(line.unexpected(expected));
        }
        *row = line.numbers(&line.fields(), expected)?;
        let fits = match index {
            0 => row[0] > 0.0 && row[1].abs() < 1e-6 && row.iter().all(|v| v.is_finite()),
            1 => row[0].abs() < 1e-6 && row[1] > 0.0 && row.iter().all(|v| v.is_finite()),
            _ => *row == [0.0, 0.0, 1.0],
        };
        if !fits {
            return Err(line.unexpected(expected));
        }
    }
    if let Some(line) = lines.next() {
        return Err(line.unexpected("the end of the file after three rows"));
    }
    Ok(Intrinsics {
        focal_px: (rows[0][0], rows[1][1]),
        centre_px: Some((rows[0][2], rows[1][2])),
        distortion: Distortion::None,
        size_px: None,
        scalable: false,
        origin: file.path().display().to_string(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Intrinsics, DatasetError> {
        parse_matrix(&TextFile::from_bytes(Path::new("k.txt"), text.into()).unwrap())
    }

    #[test]
    fn a_matrix_gives_focal_lengths_and_centre() {
        let k = parse("525 0 320\n0 520 240\n0 0 1\n").unwrap();
        assert_eq!((k.focal_px, k.centre_px), ((525.0, 520.0), Some((320.0, 240.0))));
    }

    #[test]
    fn a_bad_matrix_is_named_by_line() {
        for (text, start) in [
            ("", "k.txt, line 1: found the end of the file"),
            ("525 0 320\n0 520 240\n", "k.txt, line 3: found the end of the file"),
            ("525 3 320\n", "k.txt, line 1: found \"525 3 320\""),
            ("525 0 320\n0 -1 240\n", "k.txt, line 2: found \"0 -1 240\""),
            ("525 0 320\n0 1 240\n0 0 2\n", "k.txt, line 3: found \"0 0 2\""),
            ("525 0 320\n0 1 240\n0 0 1\n0 0 1\n", "k.txt, line 4: found \"0 0 1\""),
            ("525 0 nan\n", "k.txt, line 1: found \"525 0 nan\""),
            ("525 0\n", "k.txt, line 1: found 2 fields"),
        ] {
            let error = parse(text).unwrap_err().to_string();
            assert!(error.starts_with(start), "{error}");
        }
    }

    #[test]
    fn distortion_is_read_or_named_by_line() {
        let parse =
            |text: &str| parse_distortion(&TextFile::from_bytes(Path::new("d.txt"), text.into()).unwrap());
        assert_eq!(
            parse("# lens\nplumb_bob 1 2 3 4 5\n").unwrap(),
            Distortion::PlumbBob([1., 2., 3., 4., 5.])
        );
        assert_eq!(parse("equidistant 1 2 3 4\n").unwrap(), Distortion::Equidistant([1., 2., 3., 4.]));
        assert_eq!(parse("none\n").unwrap(), Distortion::None);
        for (text, start) in [
            ("", "d.txt, line 1: found the end of the file"),
            ("plumb_bob 1 2 3 4\n", "d.txt, line 1: found \"plumb_bob 1 2 3 4\""),
            ("equidistant 1 2 3 x\n", "d.txt, line 1: found \"x\""),
            ("none\nnone\n", "d.txt, line 2: found \"none\""),
        ] {
            let error = parse(text).unwrap_err().to_string();
            assert!(error.starts_with(start), "{error}");
        }
    }

    #[test]
    fn a_calibration_is_not_scaled_but_published_figures_are() {
        let mut k = parse("500 0 320\n0 500 240\n0 0 1\n").unwrap();
        k.size_px = Some((640, 480));
        let image = Some((Path::new("a.png"), (320, 240)));
        let message = k.camera(image).unwrap_err().to_string();
        assert!(message.starts_with("k.txt gives intrinsics for 640x480, but a.png is 320x240"), "{message}");
        k.scalable = true;
        assert_eq!(k.camera(image).unwrap().unwrap().focal_px(), (250.0, 250.0));
        assert!(k.camera(None).unwrap().is_some());
    }
}
