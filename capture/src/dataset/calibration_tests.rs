use std::path::Path;

use proptest::prelude::*;

use super::*;

const ROS: &str = "image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [438.783367, 0.000000, 305.593336, 0.000000, 437.302876, 243.738352, 0.000000, 0.000000, 1.000000]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.361976, 0.110510, 0.001014, 0.000505, 0.000000]
rectification_matrix:
  rows: 3
  cols: 3
  data: [0.999978, 0.002789, -0.006046, -0.002816, 0.999986, -0.004401, 0.006034, 0.004417, 0.999972]
projection_matrix:
  rows: 3
  cols: 4
  data: [393.653800, 0.000000, 322.797939, 0.000000, 0.000000, 393.653800, 241.090902, 0.0, 0.0, 0.0, 1.0, 0.0]
";

const MESSAGE: &str = "header:
  stamp:
    sec: 1
    nanosec: 5
  frame_id: cam
height: 480
width: 640
distortion_model: plumb_bob
d:
- -0.1
- 0.02
- 0.0
- 0.0
- 0.0
k:
- 500.0
- 0.0
- 320.0
- 0.0
- 501.0
- 240.0
- 0.0
- 0.0
- 1.0
binning_x: 0
---
";

const KALIBR: &str = "cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.29545645106987487, 0.08623215442601266, 2.0132892276082517e-06, 1.3924531371276508e-05]
  distortion_model: radtan
  intrinsics: [461.62, 460.15, 362.68, 246.03]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
  T_cam_imu:
  - [0.01, 0.99, -0.01, 0.06]
  - [-0.99, 0.01, 0.02, -0.02]
  - [0.02, 0.01, 0.99, -0.01]
  - [0.0, 0.0, 0.0, 1.0]
cam1:
  camera_model: pinhole
  distortion_coeffs: [-0.01, 0.02, -0.03, 0.004]
  distortion_model: equidistant
  intrinsics: [460.0, 459.0, 370.0, 250.0]
  resolution: [752, 480]
";

const OPENCV: &str = "%YAML:1.0
---
calibration_time: \"Thu 01 Jan 2026\"
nr_of_frames: 13
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 5.3591573396163199e+02, 0., 3.4228315473308373e+02, 0.,
       5.3591573396163199e+02, 2.3557082909788173e+02, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -2.6637260909660682e-01, -3.8588898922304653e-02,
       1.7831947042852964e-03, -2.8122100441115472e-04,
       2.3839153080878486e-01 ]
avg_reprojection_error: 3.92e-01
";

fn named(text: &str, name: Option<&str>) -> Result<Calibration, DatasetError> {
    parse(&TextFile::from_bytes(Path::new("c.yaml"), text.into())?, name)
}

fn refusal(text: &str) -> String {
    named(text, None).unwrap_err().to_string()
}

#[test]
fn ros_camera_info_is_read_and_its_rectification_is_told() {
    let Calibration { camera, notes } = named(ROS, None).unwrap();
    assert_eq!((camera.size_px(), camera.focal_px()), ((640, 480), (438.783367, 437.302876)));
    assert_eq!(camera.centre_px(), (305.593336, 243.738352));
    assert_eq!(camera.distortion(), Distortion::PlumbBob([-0.361976, 0.110510, 0.001014, 0.000505, 0.0]));
    assert!(notes[0].contains("rectification"), "{notes:?}");
    let fisheye = ROS.replace("plumb_bob", "equidistant").replace("0.000505, 0.000000]", "0.000505]");
    let camera = named(&fisheye, None).unwrap().camera;
    assert_eq!(camera.distortion(), Distortion::Equidistant([-0.361976, 0.110510, 0.001014, 0.000505]));
    let rational = ROS.replace("plumb_bob", "rational_polynomial");
    let zeros = rational.replace("0.000505, 0.000000]", "0.000505, 0.1, 0, 0, 0.0]");
    assert!(matches!(named(&zeros, None).unwrap().camera.distortion(), Distortion::PlumbBob([.., 0.1])));
    let higher = rational.replace("0.000505, 0.000000]", "0.000505, 0.1, 0.2, 0, 0]");
    assert!(refusal(&higher).starts_with("c.yaml, line 12: found the coefficients"), "{}", refusal(&higher));
}

#[test]
fn a_ros_message_is_read() {
    let camera = named(MESSAGE, None).unwrap().camera;
    assert_eq!((camera.focal_px(), camera.centre_px()), ((500.0, 501.0), (320.0, 240.0)));
    assert!(refusal(&MESSAGE.replace("binning_x: 0", "binning_x: 2")).contains("without binning"));
}

#[test]
fn a_kalibr_chain_gives_the_camera_that_is_asked_for() {
    let Calibration { camera, notes } = named(KALIBR, Some("cam0")).unwrap();
    assert_eq!((camera.size_px(), camera.focal_px()), ((752, 480), (461.62, 460.15)));
    assert!(matches!(camera.distortion(), Distortion::PlumbBob([.., 0.0])) && notes[0].contains("T_cam_imu"));
    let camera = named(KALIBR, Some("cam1")).unwrap().camera;
    assert_eq!(camera.distortion(), Distortion::Equidistant([-0.01, 0.02, -0.03, 0.004]));
    assert!(refusal(KALIBR).contains("2 cameras") && refusal(KALIBR).contains("cam0, cam1"));
    let missing = named(KALIBR, Some("cam7")).unwrap_err().to_string();
    assert!(missing.contains("no camera \"cam7\""), "{missing}");
    let one = KALIBR.split("cam1:").next().unwrap();
    assert_eq!(named(one, None).unwrap().camera.size_px(), (752, 480));
    assert!(named(ROS, Some("cam0")).is_err());
}

#[test]
fn opencv_storage_is_read() {
    let camera = named(OPENCV, None).unwrap().camera;
    assert_eq!(camera.size_px(), (640, 480));
    assert!((camera.focal_px().0 - 535.915_733_961_63).abs() < 1e-9);
    let Distortion::PlumbBob([k1, .., k3]) = camera.distortion() else { panic!("{camera:?}") };
    assert!((k1 + 0.266_372_609_096).abs() < 1e-9 && (k3 - 0.238_391_530_808).abs() < 1e-9);
    let fisheye = OPENCV
        .replace("image_width", "fisheye_model: 1\nimage_width")
        .replace("-2.8122100441115472e-04,\n       2.3839153080878486e-01 ]", "-2.8122100441115472e-04 ]");
    assert!(matches!(named(&fisheye, None).unwrap().camera.distortion(), Distortion::Equidistant(_)));
    let names =
        OPENCV.replace("camera_matrix", "cameraMatrix").replace("distortion_coefficients", "distCoeffs");
    let names = names.replace("image_width: 640\nimage_height: 480", "imageSize: [640, 480]");
    assert_eq!(named(&names, None).unwrap().camera, camera);
}

#[test]
fn an_euroc_sensor_is_read() {
    let text = "T_BS:\n  data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0.5, 0, 0, 0, 1]\nresolution: [8, 6]\n\
                intrinsics: [10, 11, 4, 3]\ndistortion_model: equidistant\ndistortion_coefficients: [1, 2, 3, 4]\n";
    let Calibration { camera, notes } = named(text, None).unwrap();
    assert_eq!((camera.focal_px(), notes.len()), ((10.0, 11.0), 1));
    assert!(refusal(&text.replace("resolution: [8, 6]\n", "")).contains("no `resolution`"));
}

#[test]
fn what_is_wrong_is_named_by_line_and_key() {
    for (text, from, to, start) in [
        (ROS, "image_width: 640\n", "", "c.yaml, line 1: found no `image_width`"),
        (ROS, "640", "640.5", "c.yaml, line 1: found 640.5"),
        (ROS, "438.783367, 0.000000", "438.783367, 3.0", "c.yaml, line 7: found [438.783367, 3,"),
        (ROS, "438.783367", "-438.783367", "c.yaml, line 7: found camera fx is -438.783367"),
        (ROS, "438.783367", "inch", "c.yaml, line 7: found an entry that is no finite number"),
        (ROS, "plumb_bob", "omni", "c.yaml, line 8: found distortion_model \"omni\""),
        (ROS, "[-0.361976, 0.110510, ", "[", "c.yaml, line 12: found the coefficients [0.001014"),
        (KALIBR, "0.08623215442601266, ", "", "c.yaml, line 4: found the coefficients"),
        (KALIBR, "pinhole", "omni", "c.yaml, line 3: found camera_model \"omni\""),
        (KALIBR, "radtan", "fov", "c.yaml, line 5: found distortion_model \"fov\""),
        (OPENCV, "camera_matrix", "matrix_of_camera", "c.yaml, line 3: found no `camera_matrix`"),
    ] {
        let text = text.replacen(from, to, 1);
        let name = text.starts_with("cam0").then_some("cam0");
        let message = named(&text, name).unwrap_err().to_string();
        assert!(message.starts_with(start), "{message}");
    }
    for text in ["", "<?xml version=\"1.0\"?>\n<opencv_storage>\n", "- 1\n", "a: 1\n", "\u{0}"] {
        assert!(refusal(text).starts_with("c.yaml, line "), "{}", refusal(text));
    }
    assert!(refusal(&"[".repeat(100_000)).contains("too long or too deep"));
    let laughs: String = (1..40).map(|n| format!("a{n}: &a{n} [*a{0}, *a{0}]\n", n - 1)).collect();
    assert!(refusal(&format!("a0: &a0 [1]\n{laughs}")).contains("too long or too deep"));
}

proptest! {
    #[test]
    fn any_bytes_are_survived(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        if let Ok(file) = TextFile::from_bytes(Path::new("c.yaml"), bytes) {
            let _ = parse(&file, None);
        }
    }

    #[test]
    fn any_damage_parses_or_is_named(which in 0usize..4, at in 0usize..3000, value in "\\PC|\\n|[-:\\[\\]{}&*!]{1,3}") {
        let mut text = [ROS, KALIBR, OPENCV, MESSAGE][which].to_owned();
        let at = at % text.len();
        text.replace_range(at..=at, &value);
        if let Err(error) = named(&text, (which == 1).then_some("cam0")) {
            prop_assert!(error.to_string().starts_with("c.yaml, line "), "{}", error);
        }
    }
}
