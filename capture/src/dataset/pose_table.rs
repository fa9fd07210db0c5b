//! Ground truth that lies in one file: by time, by frame number, or by image name.

use grnet_geometry::{Pose, se3::interpolate};
use std::collections::HashMap;
use std::path::Path;
use std::time::Duration;

use super::pose::{Invalid, from_quaternion, from_rows};
use super::text::{Line, TextFile, parse_number, quoted};
use super::{Association, DatasetError};

/// Poses of one file.
#[derive(Debug)]
pub(crate) enum PoseTable {
    /// In order of time; `None` for an impossible pose. `world_from_sensor`.
    Timed(Vec<(u64, Option<Pose>)>),
    /// Of KITTI: by frame number. `world_from_sensor`.
    Numbered(HashMap<u64, Pose>),
    /// Of pseudo ground truth and COLMAP: by image name without extension; maybe with a focal length in pixels.
    /// `world_from_camera` (the files hold the inverse).
    Named(HashMap<String, (Pose, Option<f64>)>),
}

impl PoseTable {
    /// Reads a file of any of the formats, found out from its first data line.
    pub fn read_any(path: &Path, invalid: &mut Invalid) -> Result<Self, DatasetError> {
        Self::parse_any(&TextFile::read(path)?, invalid)
    }

    pub fn parse_any(file: &TextFile, invalid: &mut Invalid) -> Result<Self, DatasetError> {
        let expected = "a TUM trajectory (8 numbers a line), KITTI poses (12 or 13), an EuRoC state file \
                        (commas), or a list `image qw qx qy qz tx ty tz [focal_px]`";
        let Some(first) = file.data_lines().next() else {
            return Err(file.end().unexpected(expected));
        };
        let fields = first.fields();
        if first.text.contains(',') {
            Self::parse_asl(file, invalid)
        } else if parse_number(fields[0]).is_none() {
            Self::parse_names(file, invalid)
        } else {
            match fields.len() {
                8 => Self::parse_tum(file, invalid),
                12 | 13 => Self::parse_kitti(file, invalid),
                n => Err(first.error(format!("{n} fields in {}", quoted(first.text)), expected)),
            }
        }
    }

    /// TUM trajectory: `time_s tx ty tz qx qy qz qw`.
    pub fn parse_tum(file: &TextFile, invalid: &mut Invalid) -> Result<Self, DatasetError> {
        let expected = "`time_s tx ty tz qx qy qz qw`: eight numbers";
        let mut rows = Vec::new();
        for line in file.data_lines() {
            let fields = line.fields();
            let [_, tx, ty, tz, qx, qy, qz, qw] = line.numbers(&fields, expected)?;
            let time_ns = line.seconds_ns(fields[0], expected)?;
            let pose = invalid.judge(&line, from_quaternion([tx, ty, tz], [qx, qy, qz, qw]))?;
            push_in_order(&mut rows, &line, time_ns, pose)?;
        }
        Ok(Self::Timed(rows))
    }

    /// EuRoC/ASL state: `time_ns, px, py, pz, qw, qx, qy, qz` and more.
    pub fn parse_asl(file: &TextFile, invalid: &mut Invalid) -> Result<Self, DatasetError> {
        let expected = "`time_ns, px, py, pz, qw, qx, qy, qz` (more may follow)";
        let mut rows = Vec::new();
        for line in file.data_lines() {
            let fields = line.comma_fields();
            if fields.len() < 8 {
                return Err(line.error(format!("{} fields in {}", fields.len(), quoted(line.text)), expected));
            }
            let time_ns = line.integer(fields[0], expected)?;
            let [px, py, pz, qw, qx, qy, qz] = line.numbers(&fields[1..8], expected)?;
            let pose = invalid.judge(&line, from_quaternion([px, py, pz], [qx, qy, qz, qw]))?;
            push_in_order(&mut rows, &line, time_ns, pose)?;
        }
        Ok(Self::Timed(rows))
    }

    /// KITTI odometry: the twelve numbers of [R | t] row by row; thirteen when the frame number comes first.
    pub fn parse_kitti(file: &TextFile, invalid: &mut Invalid) -> Result<Self, DatasetError> {
        let expected = "the twelve numbers of [R | t], or thirteen with the frame number first";
        let mut by_number = HashMap::new();
        let mut columns = None;
        for (row, line) in file.data_lines().enumerate() {
            let fields = line.fields();
            let columns = *columns.get_or_insert(fields.len());
            let (number, entries) = match (columns, fields.len()) {
                (12, 12) => (row as u64, &fields[..]),
                // Some tools print the number as 12.0 or 1.2e1.
                (13, 13) => match line.finite(fields[0], expected)? {
                    number if number >= 0.0 && number.fract() == 0.0 && number < 1e15 => {
                        (number as u64, &fields[1..])
                    }
                    _ => return Err(line.error(quoted(fields[0]), "a frame number")),
                },
                (_, n) => {
                    return Err(line.error(format!("{n} fields in {}", quoted(line.text)), expected));
                }
            };
            let rows = line.numbers::<12>(entries, expected)?;
            if let Some(pose) = invalid.judge(&line, from_rows(&rows))?
                && by_number.insert(number, pose).is_some()
            {
                return Err(line.error(format!("frame {number} again"), "each frame once"));
            }
        }
        Ok(Self::Numbered(by_number))
    }

    /// `image qw qx qy qz tx ty tz [focal_px]`, `camera_from_world`: the pseudo ground truth of 7-Scenes and
    /// 12-Scenes of Brachmann et al., "On the Limits of Pseudo Ground Truth in Visual Camera Re-Localisation".
    pub fn parse_names(file: &TextFile, invalid: &mut Invalid) -> Result<Self, DatasetError> {
        let expected = "`image qw qx qy qz tx ty tz [focal_px]`";
        let mut by_name = HashMap::new();
        for line in file.data_lines() {
            let fields = line.fields();
            if !matches!(fields.len(), 8 | 9) {
                return Err(line.error(format!("{} fields in {}", fields.len(), quoted(line.text)), expected));
            }
            let [qw, qx, qy, qz, tx, ty, tz] = line.numbers(&fields[1..8], expected)?;
            let focal_px = match fields.get(8) {
                None => None,
                Some(field) => match line.finite(field, "a focal length in pixels")? {
                    focal_px if focal_px > 0.0 => Some(focal_px),
                    _ => return Err(line.error(quoted(field), "a focal length in pixels, more than 0")),
                },
            };
            let camera_from_world = from_quaternion([tx, ty, tz], [qx, qy, qz, qw]);
            let Some(camera_from_world) = invalid.judge(&line, camera_from_world)? else { continue };
            let entry = (camera_from_world.inverse(), focal_px);
            if by_name.insert(key_of(fields[0]), entry).is_some() {
                return Err(line.error(format!("{} again", quoted(fields[0])), "each image once"));
            }
        }
        Ok(Self::Named(by_name))
    }
}

/// What lists call an image: its path with `/`, without `.png`, `.jpg`, `.jpeg` and without `.color`.
pub(crate) fn key_of(name: &str) -> String {
    let name = name.replace('\\', "/");
    let mut key = name.strip_prefix("./").unwrap_or(&name);
    if crate::decode::is_image_name(Path::new(key)) {
        key = key.rsplit_once('.').map_or(key, |(stem, _)| stem);
    }
    key.strip_suffix(".color").unwrap_or(key).to_string()
}

/// The rows that hold a pose.
pub(crate) fn known(rows: &[(u64, Option<Pose>)]) -> Vec<(u64, Pose)> {
    rows.iter().filter_map(|(time_ns, pose)| Some((*time_ns, (*pose)?))).collect()
}

/// The pose at a time, from poses in order of time.
pub(crate) fn pose_at(rows: &[(u64, Pose)], time_ns: u64, association: Association) -> Option<Pose> {
    let after = rows.partition_point(|(time, _)| *time < time_ns);
    let within = |gap: Duration, row: Option<&(u64, Pose)>| {
        row.copied().filter(|(time, _)| u128::from(time.abs_diff(time_ns)) <= gap.as_nanos())
    };
    let before = after.checked_sub(1).and_then(|index| rows.get(index));
    match association {
        Association::Nearest(gap) => {
            let nearest = [before, rows.get(after)];
            let nearest = nearest.into_iter().filter_map(|row| within(gap, row));
            nearest.min_by_key(|(time, _)| time.abs_diff(time_ns)).map(|(_, pose)| pose)
        }
        Association::Interpolate(gap) => {
            let (next_ns, next) = within(gap, rows.get(after))?;
            if next_ns == time_ns {
                return Some(next);
            }
            let (last_ns, last) = within(gap, before)?;
            let t = (time_ns - last_ns) as f64 / (next_ns - last_ns) as f64;
            Some(interpolate(&last, &next, t))
        }
    }
}

fn push_in_order(
    rows: &mut Vec<(u64, Option<Pose>)>,
    line: &Line<'_>,
    time_ns: u64,
    pose: Option<Pose>,
) -> Result<(), DatasetError> {
    if rows.last().is_some_and(|(last_ns, _)| time_ns < *last_ns) {
        let expected = "times in growing order";
        return Err(line.error(format!("a time before the line above in {}", quoted(line.text)), expected));
    }
    rows.push((time_ns, pose));
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::InvalidPoses;
    use proptest::prelude::*;

    fn parse(text: &str, policy: InvalidPoses) -> Result<(PoseTable, usize), DatasetError> {
        let mut invalid = Invalid::new(policy);
        let file = TextFile::from_bytes(Path::new("gt.txt"), text.into()).unwrap();
        PoseTable::parse_any(&file, &mut invalid).map(|table| (table, invalid.count))
    }

    fn forgiving(text: &str) -> PoseTable {
        parse(text, InvalidPoses::Forget).unwrap().0
    }

    #[test]
    fn each_format_is_known_by_its_first_line() {
        let PoseTable::Timed(tum) = forgiving("# t\n1.5 1 2 3 0 0 0 1\n") else { panic!() };
        let tum = known(&tum);
        assert_eq!((tum[0].0, tum[0].1.translation.vector.as_slice()), (1_500_000_000, &[1.0, 2.0, 3.0][..]));
        let PoseTable::Timed(asl) = forgiving("#t\n7,1,2,3,0,1,0,0,9,9\n") else { panic!() };
        let asl = known(&asl);
        assert_eq!((asl[0].0, asl[0].1.rotation.coords.x), (7, 1.0));
        let PoseTable::Numbered(kitti) = forgiving("1 0 0 5 0 1 0 0 0 0 1 0\n") else { panic!() };
        assert_eq!(kitti[&0].translation.x, 5.0);
        let PoseTable::Numbered(kitti) = forgiving("4 1 0 0 5 0 1 0 0 0 0 1 0\n") else { panic!() };
        assert_eq!(kitti[&4].translation.x, 5.0);
    }

    #[test]
    fn name_lists_hold_the_inverse_and_a_focal_length() {
        // A quarter turn about z, then a shift: camera_from_world.
        let h = std::f64::consts::FRAC_1_SQRT_2;
        let text = format!("seq-03/frame-000002.color.png {h} 0 0 {h} 1 0 0 525.5\n");
        let PoseTable::Named(table) = forgiving(&text) else { panic!() };
        let (pose, focal_px) = table["seq-03/frame-000002"];
        // -R^T t with R^T mapping x to -y.
        assert!((pose.translation.vector - nalgebra::Vector3::new(0.0, 1.0, 0.0)).norm() < 1e-12);
        assert_eq!(focal_px, Some(525.5));
    }

    #[test]
    fn impossible_poses_are_counted_or_refused() {
        let text = "1 0 0 0 0 0 0 1\n2 nan 0 0 0 0 0 1\n3 0 0 0 0 0 0 0\n";
        let (PoseTable::Timed(rows), 2) = parse(text, InvalidPoses::Forget).unwrap() else { panic!() };
        assert_eq!((rows.len(), known(&rows).len()), (3, 1));
        let error = parse(text, InvalidPoses::Refuse).unwrap_err().to_string();
        assert_eq!(error, "gt.txt, line 2: the pose holds NaN, which is no finite number");
    }

    #[test]
    fn bad_lines_are_named() {
        for (text, start) in [
            ("", "gt.txt, line 1: found the end of the file, expected a TUM trajectory"),
            ("1 2 3\n", "gt.txt, line 1: found 3 fields in \"1 2 3\""),
            ("1 0 0 0 0 0 0 1\n1.5 0 0 x 0 0 0 1\n", "gt.txt, line 2: found \"x\""),
            ("2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "gt.txt, line 2: found a time before the line above"),
            ("-2 0 0 0 0 0 0 1\n", "gt.txt, line 1: found \"-2\""),
            ("1 0 0 5 0 1 0 0 0 0 1 0\n1 2 3\n", "gt.txt, line 2: found 3 fields"),
            ("1,2\n", "gt.txt, line 1: found 2 fields"),
            ("a.png 1 0 0 0 0 0 0\na.jpg 1 0 0 0 0 0 0\n", "gt.txt, line 2: found \"a.jpg\" again"),
            ("a.png 1 0 0 0 0 0 0 -5\n", "gt.txt, line 1: found \"-5\", expected a focal length"),
            ("1.5 1 0 0 5 0 1 0 0 0 0 1 0\n", "gt.txt, line 1: found \"1.5\", expected a frame number"),
        ] {
            let error = parse(text, InvalidPoses::Forget).unwrap_err().to_string();
            assert!(error.starts_with(start), "{error}");
        }
    }

    #[test]
    fn times_are_associated_within_the_gap() {
        let at = |x: f64| Pose::translation(x, 0.0, 0.0);
        let rows = [(100, at(0.0)), (200, at(1.0)), (1000, at(2.0))];
        let x = |time_ns, association| pose_at(&rows, time_ns, association).map(|pose| pose.translation.x);
        let gap = Duration::from_nanos(80);
        assert_eq!(x(125, Association::Interpolate(gap)), Some(0.25));
        assert_eq!(x(200, Association::Interpolate(gap)), Some(1.0));
        assert_eq!(x(250, Association::Interpolate(gap)), None);
        assert_eq!(x(99, Association::Interpolate(gap)), None);
        assert_eq!(x(1001, Association::Interpolate(gap)), None);
        assert_eq!(x(140, Association::Nearest(gap)), Some(0.0));
        assert_eq!(x(160, Association::Nearest(gap)), Some(1.0));
        assert_eq!(x(1080, Association::Nearest(gap)), Some(2.0));
        assert_eq!(x(1081, Association::Nearest(gap)), None);
    }

    proptest! {
        #[test]
        fn any_text_gives_a_table_or_an_error_with_a_line(text in "([-0-9.enaif#, \\n]|\\PC){0,200}") {
            if let Err(error) = parse(&text, InvalidPoses::Refuse) {
                prop_assert!(error.to_string().starts_with("gt.txt, line "), "{}", error);
            }
        }

        #[test]
        fn a_damaged_line_is_found(row in 0usize..20, column in 0usize..8, junk in "[a-z!]{1,5}") {
            prop_assume!(parse_number(&junk).is_none());
            let mut lines: Vec<Vec<String>> =
                (0..20).map(|t| format!("{t} 0 0 0 0 0 0 1").split(' ').map(String::from).collect()).collect();
            lines[row][column] = junk;
            // A name in the first field of the first line makes it another format.
            prop_assume!(row > 0 || column > 0);
            let text = lines.iter().map(|line| line.join(" ")).collect::<Vec<_>>().join("\n");
            let error = parse(&text, InvalidPoses::Forget).unwrap_err().to_string();
            prop_assert!(error.starts_with(&format!("gt.txt, line {}: found", row + 1)), "{}", error);
        }
    }
}
