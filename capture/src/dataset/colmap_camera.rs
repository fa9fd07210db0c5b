//! `cameras.txt` of COLMAP: the camera models that a pinhole with plumb-bob or equidistant distortion can say.

use std::collections::HashMap;

use grnet_frame::{Camera, Distortion};

use super::DatasetError;
use super::intrinsics::Intrinsics;
use super::text::{TextFile, quoted};

const MODELS: &str = "SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, FULL_OPENCV (with k4 = k5 = k6 = 0), \
                      OPENCV_FISHEYE, SIMPLE_RADIAL_FISHEYE or RADIAL_FISHEYE";

/// Intrinsics by camera id.
pub(crate) fn parse_cameras(file: &TextFile) -> Result<HashMap<u64, Intrinsics>, DatasetError> {
    let expected = "`camera_id model width height parameters...`";
    let mut cameras = HashMap::new();
    for line in file.data_lines() {
        let fields = line.fields();
        if fields.len() < 5 {
            return Err(line.error(format!("{} fields in {}", fields.len(), quoted(line.text)), expected));
        }
        let id = line.integer(fields[0], expected)?;
        let size = |field: &str| {
            let pixels = line.integer(field, expected)?;
            u32::try_from(pixels).map_err(|_| line.error(quoted(field), "an image size in pixels"))
        };
        let size_px = (size(fields[2])?, size(fields[3])?);
        let parameters: Result<Vec<f64>, _> =
            fields[4..].iter().map(|field| line.finite(field, "a finite number")).collect();
        let Some((focal_px, (cx, cy), distortion)) = model(fields[1], &parameters?) else {
            let found = format!("{} with {} parameters", quoted(fields[1]), fields.len() - 4);
            return Err(line.error(found, format!("{MODELS}, with its parameters")));
        };
        // COLMAP's first pixel centre is at 0.5.
        let centre_px = (cx - 0.5, cy - 0.5);
        let camera = Camera::new(size_px, focal_px, centre_px, distortion)
            .map_err(|error| line.error(error, "a possible camera"))?;
        let origin = format!("{}, line {}", line.path.display(), line.number);
        if cameras.insert(id, Intrinsics::of(&camera, origin)).is_some() {
            return Err(line.error(format!("camera {id} again"), "each camera once"));
        }
    }
    Ok(cameras)
}

type Parameters = ((f64, f64), (f64, f64), Distortion);

/// Focal lengths, principal point (COLMAP's convention) and distortion of a model.
fn model(name: &str, p: &[f64]) -> Option<Parameters> {
    let plumb_bob = |k1, k2, p1, p2, k3| Distortion::PlumbBob([k1, k2, p1, p2, k3]);
    Some(match (name, p) {
        ("SIMPLE_PINHOLE", &[f, cx, cy]) => ((f, f), (cx, cy), Distortion::None),
        ("PINHOLE", &[fx, fy, cx, cy]) => ((fx, fy), (cx, cy), Distortion::None),
        ("SIMPLE_RADIAL", &[f, cx, cy, k]) => ((f, f), (cx, cy), plumb_bob(k, 0.0, 0.0, 0.0, 0.0)),
        ("RADIAL", &[f, cx, cy, k1, k2]) => ((f, f), (cx, cy), plumb_bob(k1, k2, 0.0, 0.0, 0.0)),
        ("OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2])
        | ("FULL_OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2, 0.0, 0.0, 0.0, 0.0]) => {
            ((fx, fy), (cx, cy), plumb_bob(k1, k2, p1, p2, 0.0))
        }
        ("FULL_OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]) => {
            ((fx, fy), (cx, cy), plumb_bob(k1, k2, p1, p2, k3))
        }
        ("OPENCV_FISHEYE", &[fx, fy, cx, cy, k1, k2, k3, k4]) => {
            ((fx, fy), (cx, cy), Distortion::Equidistant([k1, k2, k3, k4]))
        }
        ("SIMPLE_RADIAL_FISHEYE", &[f, cx, cy, k]) => {
            ((f, f), (cx, cy), Distortion::Equidistant([k, 0.0, 0.0, 0.0]))
        }
        ("RADIAL_FISHEYE", &[f, cx, cy, k1, k2]) => {
            ((f, f), (cx, cy), Distortion::Equidistant([k1, k2, 0.0, 0.0]))
        }
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::path::Path;

    fn parse(text: &str) -> Result<HashMap<u64, Intrinsics>, DatasetError> {
        parse_cameras(&TextFile::from_bytes(Path::new("cameras.txt"), text.into()).unwrap())
    }

    #[test]
    fn models_become_cameras_half_a_pixel_apart() {
        let text = "# id\n1 SIMPLE_RADIAL 640 480 500 320 240 0.1\n4 OPENCV_FISHEYE 640 480 1 2 3 4 5 6 7 8\n\
                    5 FULL_OPENCV 640 480 500 501 320 240 1 2 3 4 5 0 0 0\n6 PINHOLE 640 480 500 501 320 240\n";
        let cameras = parse(text).unwrap();
        let one = &cameras[&1];
        assert_eq!(
            (one.focal_px, one.centre_px, one.size_px),
            ((500.0, 500.0), Some((319.5, 239.5)), Some((640, 480)))
        );
        assert_eq!(one.distortion, Distortion::PlumbBob([0.1, 0.0, 0.0, 0.0, 0.0]));
        assert_eq!(cameras[&4].distortion, Distortion::Equidistant([5.0, 6.0, 7.0, 8.0]));
        assert_eq!(cameras[&5].distortion, Distortion::PlumbBob([1.0, 2.0, 3.0, 4.0, 5.0]));
        assert_eq!((cameras[&6].focal_px, cameras[&6].distortion), ((500.0, 501.0), Distortion::None));
    }

    #[test]
    fn bad_lines_are_named() {
        for (text, start) in [
            ("1 PINHOLE 640\n", "cameras.txt, line 1: found 3 fields"),
            ("1 PINHOLE 640 480 500\n", "cameras.txt, line 1: found \"PINHOLE\" with 1 parameters"),
            ("1 FOV 640 480 1 2 3 4 5\n", "cameras.txt, line 1: found \"FOV\" with 5 parameters"),
            ("1 FULL_OPENCV 640 480 1 1 3 4 0 0 0 0 0 0 0 9\n", "cameras.txt, line 1: found \"FULL_OPENCV\""),
            ("1 SIMPLE_PINHOLE 640 480 -1 2 3\n", "cameras.txt, line 1: found camera fx is -1"),
            ("1 SIMPLE_PINHOLE 640 480 nan 2 3\n", "cameras.txt, line 1: found \"nan\""),
            ("1 SIMPLE_PINHOLE 99999999999 480 1 2 3\n", "cameras.txt, line 1: found \"99999999999\""),
            (
                "1 SIMPLE_PINHOLE 1 1 1 2 3\n1 SIMPLE_PINHOLE 1 1 1 2 3\n",
                "cameras.txt, line 2: found camera 1 again",
            ),
        ] {
            let error = parse(text).err().unwrap().to_string();
            assert!(error.starts_with(start), "{error}");
        }
    }

    proptest! {
        #[test]
        fn any_text_parses_or_is_named(text in "(PINHOLE|OPENCV|[-0-9.e \\n]|\\PC){0,100}") {
            if let Err(error) = parse(&text) {
                prop_assert!(error.to_string().starts_with("cameras.txt, line "), "{}", error);
            }
        }
    }
}
