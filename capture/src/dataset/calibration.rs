//! Calibration files of common tools: one camera's intrinsics and distortion.
//!
//! The kind of file is found out from its keys:
//!
//! | file | keys | distortion models |
//! |---|---|---|
//! | ROS `camera_info` as `camera_calibration` writes it | `camera_matrix.data`, `distortion_model` | `plumb_bob`, `equidistant` / `fisheye`, `rational_polynomial` without k4 to k6 |
//! | ROS 2 message as `ros2 topic echo` prints it | `k`, `d`, `distortion_model` | the same |
//! | Kalibr camchain | `cam0.intrinsics`, `cam0.distortion_model` | `radtan`, `equidistant`, `none` |
//! | EuRoC / ASL `sensor.yaml` | `intrinsics` at the top | `radial-tangential`, `equidistant`, `none` |
//! | OpenCV `FileStorage` as YAML | a camera matrix and distortion coefficients under their usual names, image size | plumb-bob by four or five coefficients; fisheye when `fisheye_model` is 1 |
//!
//! Rectification and projection matrices, poses between cameras or to an IMU and time shifts are not used. What a file
//! asks for beyond these models is refused rather than left out.

use std::path::Path;

use grnet_frame::{Camera, Distortion};
use saphyr::MarkedYaml;

use super::DatasetError;
use super::sensor_yaml::parse_sensor;
use super::text::TextFile;
use super::yaml::{Reader, untagged};

/// What a calibration file says about one camera.
#[derive(Debug, Clone, PartialEq)]
pub struct Calibration {
    /// The intrinsics, at the image size that the file gives.
    pub camera: Camera,
    /// What was in the file and is not used.
    pub notes: Vec<String>,
}

/// Reads the calibration file at `path`; `name` chooses among the cameras of a Kalibr chain.
///
/// # Errors
/// See [`DatasetError`]: the file cannot be read, is of no known kind, or asks for a model that is not supported, with
/// line and key.
pub fn read(path: &Path, name: Option<&str>) -> Result<Calibration, DatasetError> {
    parse(&TextFile::read(path)?, name)
}

const WHAT: &str = "a calibration as YAML: ROS camera_info (camera_matrix, distortion_model), a Kalibr camchain (cam0: \
                    intrinsics), an EuRoC sensor.yaml (intrinsics) or OpenCV FileStorage (camera_matrix, image_width)";

pub(super) fn parse(file: &TextFile, name: Option<&str>) -> Result<Calibration, DatasetError> {
    let reader = Reader { file, what: WHAT };
    let text = reader.text();
    let root = reader.root(&text)?;
    let document = Document { reader, root: &root };
    if root.data.as_mapping_get("cam0").is_some() {
        return document.kalibr(name);
    }
    if let Some(name) = name {
        let expected =
            format!("a Kalibr camchain with the camera {name:?}; the other kinds of files hold one camera");
        return Err(reader.line(1).error("a file without `cam0`", expected));
    }
    if root.data.as_mapping_get("intrinsics").is_some() {
        return document.euroc();
    }
    let is_ros = root.data.as_mapping_get("distortion_model").is_some();
    if is_ros { document.ros() } else { document.opencv() }
}

struct Document<'a> {
    reader: Reader<'a>,
    root: &'a MarkedYaml<'a>,
}

type Node<'a> = &'a MarkedYaml<'a>;

/// A number for each axis of the image.
type Pair = (f64, f64);

impl<'a> Document<'a> {
    fn ros(&self) -> Result<Calibration, DatasetError> {
        let size_px = self.size()?;
        let matrix =
            self.need(&["camera_matrix", "k", "K"], "camera_matrix with `data`: nine numbers, row by row")?;
        let (focal_px, centre_px) = self.matrix(self.data(matrix))?;
        let model = self.need(&["distortion_model"], "distortion_model")?;
        let coefficients = self.find(&["distortion_coefficients", "d", "D"]).map(|node| self.data(node));
        let distortion = match untagged(model).as_str() {
            Some("plumb_bob" | "rational_polynomial") => self.plumb_bob(coefficients)?,
            Some("equidistant" | "fisheye") => self.equidistant(coefficients, model)?,
            Some("none" | "") => Distortion::None,
            other => return Err(self.unknown_model(model, other)),
        };
        let mut notes = Vec::new();
        let unit = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
        if let Some(node) = self.find(&["rectification_matrix", "r", "R"])
            && self.reader.numbers::<9>(self.data(node), "rectification_matrix with nine numbers")? != unit
        {
            notes.push(
                "the rectification in the calibration is not used: frames are undistorted and not turned"
                    .into(),
            );
        }
        for (key, what) in [("binning_x", "binning"), ("binning_y", "binning")] {
            if let Some(node) = self.find(&[key])
                && self.reader.number_or_switch(node, "binning 0 or 1")? > 1.0
            {
                return Err(self
                    .reader
                    .at(node)
                    .error(what, "intrinsics of the images as they come, without binning"));
            }
        }
        self.calibration(matrix, size_px, focal_px, centre_px, distortion, notes)
    }

    fn opencv(&self) -> Result<Calibration, DatasetError> {
        const MATRIX: &[&str] = &[
            "camera_matrix",
            "Camera_Matrix",
            "cameraMatrix",
            "CameraMatrix",
            "camera_Matrix",
            "K",
            "M",
            "M1",
        ];
        const COEFFICIENTS: &[&str] = &[
            "distortion_coefficients",
            "Distortion_Coefficients",
            "distCoeffs",
            "dist_coeffs",
            "DistCoeffs",
            "D",
            "D1",
        ];
        let matrix = self.need(MATRIX, WHAT)?;
        let (focal_px, centre_px) = self.matrix(self.data(matrix))?;
        let size_px = self.size()?;
        let coefficients = self.find(COEFFICIENTS).map(|node| self.data(node));
        let is_fisheye = match self.find(&["fisheye_model", "fisheye"]) {
            Some(node) => self.reader.number_or_switch(node, "fisheye_model 0 or 1")? != 0.0,
            None => false,
        };
        let distortion = match is_fisheye {
            true => self.equidistant(coefficients, matrix)?,
            false => self.plumb_bob(coefficients)?,
        };
        self.calibration(matrix, size_px, focal_px, centre_px, distortion, Vec::new())
    }

    fn kalibr(&self, name: Option<&str>) -> Result<Calibration, DatasetError> {
        let names: Vec<String> = (0..64)
            .map(|n| format!("cam{n}"))
            .filter(|name| self.root.data.as_mapping_get(name).is_some())
            .collect();
        let available = names.join(", ");
        let name = match name {
            Some(name) => name,
            None if names.len() == 1 => "cam0",
            None => {
                let expected =
                    format!("a choice of one: source.calibration_camera = \"cam0\" (there are {available})");
                return Err(self.reader.line(1).error(format!("{} cameras", names.len()), expected));
            }
        };
        let Some(camera) =
            names.iter().find(|found| *found == name).and_then(|name| self.root.data.as_mapping_get(name))
        else {
            return Err(self
                .reader
                .line(1)
                .error(format!("no camera {name:?}"), format!("one of {available}")));
        };
        let inner = Document { reader: self.reader, root: camera };
        let mut notes = Vec::new();
        if inner.find(&["T_cam_imu", "timeshift_cam_imu"]).is_some() {
            notes.push(
                "T_cam_imu and timeshift_cam_imu in the calibration are not used: see frames.base_from_camera and \
                 source.time_offset_ms"
                    .into(),
            );
        }
        if let Some(model) = inner.find(&["camera_model"])
            && untagged(model).as_str() != Some("pinhole")
        {
            let found = untagged(model).as_str().unwrap_or("that is no text");
            return Err(self
                .reader
                .at(model)
                .error(format!("camera_model {found:?}"), "camera_model pinhole"));
        }
        let intrinsics = inner.need(&["intrinsics"], "intrinsics: [fu, fv, pu, pv]")?;
        let [fu, fv, pu, pv] = self.reader.numbers::<4>(intrinsics, "intrinsics [fu, fv, pu, pv]")?;
        let resolution = inner.need(&["resolution"], "resolution: [width, height]")?;
        let size_px = inner.size_of(resolution)?;
        let coefficients = inner.find(&["distortion_coeffs"]);
        let distortion = match inner.find(&["distortion_model"]) {
            None => Distortion::None,
            Some(model) => match untagged(model).as_str() {
                Some("radtan") => inner.plumb_bob(coefficients)?,
                Some("equidistant") => inner.equidistant(coefficients, model)?,
                Some("none") => Distortion::None,
                other => return Err(inner.unknown_model(model, other)),
            },
        };
        inner.calibration(intrinsics, size_px, (fu, fv), (pu, pv), distortion, notes)
    }

    fn euroc(&self) -> Result<Calibration, DatasetError> {
        let sensor = parse_sensor(self.reader.file)?;
        let camera = sensor.intrinsics.map(|intrinsics| intrinsics.camera(None)).transpose()?.flatten();
        let notes = sensor
            .body_from_camera
            .map(|_| "T_BS in the calibration is not used: see frames.base_from_camera".into());
        let Some(camera) = camera else {
            return Err(self
                .reader
                .line(1)
                .error("no `resolution`", "resolution: [width, height] of the images"));
        };
        Ok(Calibration { camera, notes: notes.into_iter().collect() })
    }

    fn calibration(
        &self,
        node: Node<'a>,
        size_px: (u32, u32),
        focal_px: (f64, f64),
        centre_px: (f64, f64),
        distortion: Distortion,
        notes: Vec<String>,
    ) -> Result<Calibration, DatasetError> {
        let camera = Camera::new(size_px, focal_px, centre_px, distortion)
            .map_err(|error| self.reader.at(self.data(node)).error(error, "the intrinsics of a camera"))?;
        Ok(Calibration { camera, notes })
    }

    /// Nine numbers: fx 0 cx / 0 fy cy / 0 0 1.
    fn matrix(&self, node: Node<'a>) -> Result<(Pair, Pair), DatasetError> {
        let expected = "a camera matrix of nine numbers: fx 0 cx, 0 fy cy, 0 0 1";
        let [fx, skew, cx, a, fy, cy, b, c, one] = self.reader.numbers::<9>(node, expected)?;
        if skew.abs() > 1e-6 * fx.abs() || [a, b, c] != [0.0; 3] || one != 1.0 {
            let found = format!("[{fx}, {skew}, {cx}, {a}, {fy}, {cy}, {b}, {c}, {one}]");
            return Err(self.reader.at(node).error(found, expected));
        }
        Ok(((fx, fy), (cx, cy)))
    }

    /// Four or five coefficients; more when all that follow are zero.
    fn plumb_bob(&self, node: Option<Node<'a>>) -> Result<Distortion, DatasetError> {
        let Some(node) = node else { return Ok(Distortion::None) };
        let expected = "distortion coefficients [k1, k2, p1, p2(, k3)]; higher ones (k4 to k6, thin prism, tilt) only as \
                        zeros: calibrate with plumb_bob or equidistant";
        let all = self.reader.list(node, expected)?;
        if all.is_empty() {
            return Ok(Distortion::None);
        }
        if !matches!(all.len(), 4 | 5 | 8 | 12 | 14) || all.iter().skip(5).any(|k| *k != 0.0) {
            return Err(self.reader.at(node).error(format!("the coefficients {all:?}"), expected));
        }
        let k = |index: usize| all.get(index).copied().unwrap_or(0.0);
        Ok(Distortion::PlumbBob(std::array::from_fn(k)))
    }

    fn equidistant(&self, node: Option<Node<'a>>, model: Node<'a>) -> Result<Distortion, DatasetError> {
        let expected = "four distortion coefficients [k1, k2, k3, k4] of a fisheye";
        let node = node.ok_or_else(|| self.reader.at(model).error("no coefficients", expected))?;
        let mut all = self.reader.list(node, expected)?;
        // Some tools pad with a zero to five.
        if all.len() == 5 && all[4] == 0.0 {
            all.pop();
        }
        let found = format!("{} entries", all.len());
        let k = all.try_into().map_err(|_| self.reader.at(node).error(found, expected))?;
        Ok(Distortion::Equidistant(k))
    }

    fn unknown_model(&self, model: Node<'a>, found: Option<&str>) -> DatasetError {
        let found = format!("distortion_model {:?}", found.unwrap_or("that is no text"));
        self.reader.at(model).error(found, "plumb_bob (radtan), equidistant or none")
    }

    fn size(&self) -> Result<(u32, u32), DatasetError> {
        if let Some(node) = self.find(&["image_size", "imageSize", "size"]) {
            return self.size_of(node);
        }
        let side = |names: &[&str], expected: &'static str| {
            self.reader.pixels(self.need(names, expected)?, expected)
        };
        let width =
            side(&["image_width", "image_Width", "width"], "image_width: the width of the images in pixels")?;
        let height = side(
            &["image_height", "image_Height", "height"],
            "image_height: the height of the images in pixels",
        )?;
        Ok((width, height))
    }

    fn size_of(&self, node: Node<'a>) -> Result<(u32, u32), DatasetError> {
        let expected = "[width, height] in whole pixels";
        let [width, height] = self.reader.numbers::<2>(self.data(node), expected)?;
        let pixels = |value| self.reader.whole_pixels(node, value, expected);
        Ok((pixels(width)?, pixels(height)?))
    }

    /// The numbers of a matrix, which may stand under `data`.
    fn data(&self, node: Node<'a>) -> Node<'a> {
        untagged(node).as_mapping_get("data").unwrap_or(node)
    }

    fn find(&self, names: &[&str]) -> Option<Node<'a>> {
        names.iter().find_map(|name| untagged(self.root).as_mapping_get(name))
    }

    fn need(&self, names: &[&str], expected: &'static str) -> Result<Node<'a>, DatasetError> {
        self.find(names)
            .ok_or_else(|| self.reader.at(self.root).error(format!("no `{}`", names[0]), expected))
    }
}

#[cfg(test)]
#[path = "calibration_tests.rs"]
mod tests;
