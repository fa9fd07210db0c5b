//! `sensor.yaml` of the EuRoC/ASL layout.

use grnet_frame::Distortion;
use grnet_geometry::Pose;
use saphyr::MarkedYaml;

use super::DatasetError;
use super::intrinsics::Intrinsics;
use super::pose::from_rows;
use super::text::TextFile;
use super::yaml::Reader;

/// What a camera's file says; each part may be missing.
#[derive(Debug, Default)]
pub(crate) struct Sensor {
    pub intrinsics: Option<Intrinsics>,
    /// `T_BS`.
    pub body_from_camera: Option<Pose>,
}

/// Parses the file; keys that are not needed are ignored.
pub(crate) fn parse_sensor(file: &TextFile) -> Result<Sensor, DatasetError> {
    let reader = Reader { file, what: "a camera's sensor.yaml: `intrinsics: [fu, fv, cu, cv]` and so on" };
    let text = reader.text();
    let root = reader.root(&text)?;
    let document = Document { reader, root: &root };
    Ok(Sensor { intrinsics: document.intrinsics()?, body_from_camera: document.body_from_camera()? })
}

struct Document<'a> {
    reader: Reader<'a>,
    root: &'a MarkedYaml<'a>,
}

impl Document<'_> {
    fn intrinsics(&self) -> Result<Option<Intrinsics>, DatasetError> {
        let Some(node) = self.root.data.as_mapping_get("intrinsics") else { return Ok(None) };
        let expected = "intrinsics [fu, fv, cu, cv] with positive focal lengths";
        let [fu, fv, cu, cv] = self.reader.numbers::<4>(node, expected)?;
        if fu <= 0.0 || fv <= 0.0 {
            return Err(self.reader.at(node).error(format!("[{fu}, {fv}, {cu}, {cv}]"), expected));
        }
        if let Some(model) = self.root.data.as_mapping_get("camera_model")
            && model.data.as_str() != Some("pinhole")
        {
            return Err(self.reader.at(model).error("another camera_model", "pinhole"));
        }
        Ok(Some(Intrinsics {
            focal_px: (fu, fv),
            centre_px: Some((cu, cv)),
            distortion: self.distortion()?,
            size_px: self.resolution()?,
            scalable: false,
            origin: self.reader.file.path().display().to_string(),
        }))
    }

    fn distortion(&self) -> Result<Distortion, DatasetError> {
        let Some(model) = self.root.data.as_mapping_get("distortion_model") else {
            return Ok(Distortion::None);
        };
        let Some(node) = self.root.data.as_mapping_get("distortion_coefficients") else {
            return match model.data.as_str() {
                Some("none") => Ok(Distortion::None),
                _ => Err(self
                    .reader
                    .at(model)
                    .error("no distortion_coefficients", "them beside the distortion_model")),
            };
        };
        match model.data.as_str() {
            Some("radial-tangential" | "radtan" | "plumb_bob") => {
                let expected = "four or five distortion coefficients [k1, k2, p1, p2(, k3)]";
                let k = if node.data.as_sequence().is_some_and(|all| all.len() == 5) {
                    self.reader.numbers::<5>(node, expected)?
                } else {
                    let [k1, k2, p1, p2] = self.reader.numbers::<4>(node, expected)?;
                    [k1, k2, p1, p2, 0.0]
                };
                Ok(Distortion::PlumbBob(k))
            }
            Some("equidistant") => {
                let expected = "four distortion coefficients [k1, k2, k3, k4]";
                Ok(Distortion::Equidistant(self.reader.numbers::<4>(node, expected)?))
            }
            Some("none") => Ok(Distortion::None),
            other => Err(self.reader.at(model).error(
                format!("distortion_model {:?}", other.unwrap_or("that is no text")),
                "radial-tangential, equidistant or none",
            )),
        }
    }

    fn resolution(&self) -> Result<Option<(u32, u32)>, DatasetError> {
        let Some(node) = self.root.data.as_mapping_get("resolution") else { return Ok(None) };
        let expected = "resolution [width, height] in whole pixels";
        let pixels = |value: f64| self.reader.whole_pixels(node, value, expected);
        let [width, height] = self.reader.numbers::<2>(node, expected)?;
        Ok(Some((pixels(width)?, pixels(height)?)))
    }

    fn body_from_camera(&self) -> Result<Option<Pose>, DatasetError> {
        let Some(node) = self.root.data.as_mapping_get("T_BS") else { return Ok(None) };
        let expected = "T_BS with `data`: the sixteen numbers of a 4x4 rigid motion, row by row";
        let Some(data) = node.data.as_mapping_get("data") else {
            return Err(self.reader.at(node).error("no data", expected));
        };
        let matrix = self.reader.numbers::<16>(data, expected)?;
        if matrix[12..] != [0.0, 0.0, 0.0, 1.0] {
            return Err(self.reader.at(data).error(format!("the last row {:?}", &matrix[12..]), expected));
        }
        let rows: [f64; 12] = std::array::from_fn(|index| matrix[index]);
        from_rows(&rows).map(Some).map_err(|problem| self.reader.at(data).error(problem, expected))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::path::Path;

    const EUROC: &str = "# General sensor definitions.
sensor_type: camera
comment: VI-Sensor cam0 (MT9M034)

# Sensor extrinsics wrt. the body-frame.
T_BS:
  cols: 4
  rows: 4
  data: [0.0, -1.0, 0.0, 0.5,
         1.0, 0.0, 0.0, -0.25,
         0.0, 0.0, 1.0, 2,
         0.0, 0.0, 0.0, 1.0]

rate_hz: 20
resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
";

    fn parse(text: &str) -> Result<Sensor, DatasetError> {
        parse_sensor(&TextFile::from_bytes(Path::new("sensor.yaml"), text.into()).unwrap())
    }

    #[test]
    fn the_published_form_is_read() {
        let sensor = parse(EUROC).unwrap();
        let k = sensor.intrinsics.unwrap();
        assert_eq!((k.focal_px, k.centre_px), ((458.654, 457.296), Some((367.215, 248.375))));
        assert_eq!(k.size_px, Some((752, 480)));
        let Distortion::PlumbBob([k1, _, _, p2, k3]) = k.distortion else { panic!("{:?}", k.distortion) };
        assert_eq!((k1, p2, k3), (-0.28340811, 1.76187114e-05, 0.0));
        let pose = sensor.body_from_camera.unwrap();
        let point = pose * nalgebra::Point3::new(1.0, 0.0, 0.0);
        assert!((point - nalgebra::Point3::new(0.5, 0.75, 2.0)).norm() < 1e-12);
        assert!(parse(&format!("%YAML:1.0\n---\n{EUROC}")).unwrap().intrinsics.is_some());
    }

    #[test]
    fn missing_parts_are_missing() {
        let sensor = parse("sensor_type: camera\n").unwrap();
        assert!(sensor.intrinsics.is_none() && sensor.body_from_camera.is_none());
    }

    #[test]
    fn bad_parts_are_named_by_line() {
        for (from, to, start) in [
            ("[458.654, ", "[", "sensor.yaml, line 17: found 3 entries"),
            ("458.654", "four", "sensor.yaml, line 17: found an entry that is no finite number"),
            ("458.654", "-4", "sensor.yaml, line 17: found [-4"),
            ("pinhole", "omni", "sensor.yaml, line 16: found another camera_model"),
            ("radial-tangential", "fov", "sensor.yaml, line 18: found distortion_model \"fov\""),
            ("[752, 480]", "[752, 0]", "sensor.yaml, line 15: found 0"),
            ("0.0, -1.0, 0.0, 0.5", "0.0, -2.0, 0.0, 0.5", "sensor.yaml, line 9: found R^T R differs"),
            ("0.0, 0.0, 0.0, 1.0]", "0.0, 0.0, 0.0, 2.0]", "sensor.yaml, line 9: found the last row"),
        ] {
            let error = parse(&EUROC.replace(from, to)).unwrap_err().to_string();
            assert!(error.starts_with(start), "{error}");
        }
        for text in ["", "a: [1", "- 1\n", "a: b: c\n"] {
            let error = parse(text).unwrap_err().to_string();
            assert!(error.starts_with("sensor.yaml, line "), "{error}");
        }
    }

    #[test]
    fn deep_nesting_is_refused() {
        for text in ["[".repeat(100_000), "a: ".to_string() + &"[".repeat(60_000), "- ".repeat(30_000)] {
            let error = parse(&text).unwrap_err().to_string();
            assert!(error.contains("too long or too deep"), "{error}");
        }
    }

    proptest! {
        #[test]
        fn any_text_parses_or_is_named(text in "([-a-z0-9.:,\\[\\]{}&*!#\"' \\n]|\\PC){0,200}") {
            if let Err(error) = parse(&text) {
                prop_assert!(error.to_string().starts_with("sensor.yaml, line "), "{}", error);
            }
        }

        #[test]
        fn any_damage_parses_or_is_named(position in 0usize..2000, value in "\\PC|\\n") {
            let mut text = EUROC.to_string();
            let position = position % text.len();
            text.replace_range(position..=position, &value);
            if let Err(error) = parse(&text) {
                prop_assert!(error.to_string().starts_with("sensor.yaml, line "), "{}", error);
            }
        }
    }
}
