//! The KITTI odometry text format: the 3x4 matrix `world_from_camera` row by row, one pose a line.
//!
//! A line has 12 numbers, or 13 with the frame number in front (the form of `kitti-odom-eval` for results that lack
//! frames). The matrices stay as they were read beside the poses, because the public KITTI tools compute with them
//! and printed matrices are rotations only to their last digit: see [`KittiPose::matrix`].

use std::{fmt::Write as _, path::Path};

use nalgebra::{Isometry3, Matrix3, Matrix3x4, Translation3, Vector3};

use super::{
    TrajectoryError,
    error::quoted,
    tum::{content_lines, parse_finite, read_text, write_text},
};
use crate::{Pose, align::Similarity, quaternion};

/// How far a printed rotation may be from a true one (Frobenius norm); six digits give about 1e-6.
pub const ROTATION_TOLERANCE: f64 = 1e-2;

const COLUMNS: &str = "12 numbers (3x4 matrix, row by row), or 13 with the frame number in front";

/// One pose of a KITTI file.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KittiPose {
    /// Frame number: as printed, or the number of the line counted from 0.
    pub frame: u64,
    /// `[R | t]` as printed, `R` a rotation up to the printed digits.
    pub matrix: Matrix3x4<f64>,
    /// The same with `R` projected to the nearest rotation.
    pub world_from_camera: Pose,
}

/// The poses of a KITTI file in strictly increasing order of frame number.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct KittiPoses {
    poses: Vec<KittiPose>,
    indexed: bool,
}

impl KittiPoses {
    /// Poses of consecutive frames from 0.
    pub fn from_poses<'a>(poses: impl IntoIterator<Item = &'a Pose>) -> Self {
        let poses = poses.into_iter().enumerate();
        Self { poses: poses.map(|(i, pose)| KittiPose::new(i as u64, pose)).collect(), indexed: false }
    }

    /// Poses of numbered frames, sorted by frame number.
    ///
    /// # Errors
    /// The frame number that occurs twice.
    pub fn from_frames(frames: impl IntoIterator<Item = (u64, Pose)>) -> Result<Self, DuplicateFrame> {
        let mut poses: Vec<_> =
            frames.into_iter().map(|(frame, pose)| KittiPose::new(frame, &pose)).collect();
        poses.sort_by_key(|p| p.frame);
        match poses.windows(2).find(|w| w[0].frame == w[1].frame) {
            Some(twice) => Err(DuplicateFrame(twice[0].frame)),
            None => Ok(Self { poses, indexed: true }),
        }
    }

    /// All poses in order.
    pub fn poses(&self) -> &[KittiPose] {
        &self.poses
    }

    /// Whether the file had a column of frame numbers.
    pub fn is_indexed(&self) -> bool {
        self.indexed
    }

    /// Number of poses.
    pub fn len(&self) -> usize {
        self.poses.len()
    }

    /// Whether there is no pose.
    pub fn is_empty(&self) -> bool {
        self.poses.is_empty()
    }

    /// The poses seen from the first one's camera: every matrix becomes `first^-1 * matrix`.
    pub fn anchored(&self) -> Self {
        let Some(first) = self.poses.first() else { return self.clone() };
        let projected = first.world_from_camera.inverse();
        let inverse = first.rotation().try_inverse().unwrap_or_else(|| first.rotation().transpose());
        let origin = first.matrix.column(3).into_owned();
        self.map(|p| {
            let translation = inverse * (p.matrix.column(3) - origin);
            (inverse * p.rotation(), translation, projected * p.world_from_camera)
        })
    }

    /// The poses seen from another world, matrices included.
    pub fn transformed(&self, similarity: &Similarity) -> Self {
        let rotation = similarity.rotation.to_rotation_matrix().into_inner();
        self.map(|p| {
            let translation = similarity.apply_point(&p.matrix.column(3).into_owned());
            (rotation * p.rotation(), translation, similarity.apply(&p.world_from_camera))
        })
    }

    fn map(&self, moved: impl Fn(&KittiPose) -> (Matrix3<f64>, Vector3<f64>, Pose)) -> Self {
        let poses = self.poses.iter().map(|p| {
            let (rotation, translation, world_from_camera) = moved(p);
            let mut matrix = Matrix3x4::zeros();
            matrix.fixed_view_mut::<3, 3>(0, 0).copy_from(&rotation);
            matrix.set_column(3, &translation);
            KittiPose { frame: p.frame, matrix, world_from_camera }
        });
        Self { poses: poses.collect(), indexed: self.indexed }
    }

    /// The pose of a frame, if there is one.
    pub fn frame(&self, frame: u64) -> Option<&KittiPose> {
        let at = self.poses.partition_point(|p| p.frame < frame);
        self.poses.get(at).filter(|p| p.frame == frame)
    }
}

impl KittiPose {
    /// A pose with its exact matrix.
    pub fn new(frame: u64, world_from_camera: &Pose) -> Self {
        let mut matrix = Matrix3x4::zeros();
        let rotation = world_from_camera.rotation.to_rotation_matrix();
        matrix.fixed_view_mut::<3, 3>(0, 0).copy_from(rotation.matrix());
        matrix.set_column(3, &world_from_camera.translation.vector);
        Self { frame, matrix, world_from_camera: *world_from_camera }
    }

    /// The rotational part as printed.
    pub fn rotation(&self) -> Matrix3<f64> {
        self.matrix.fixed_view::<3, 3>(0, 0).into_owned()
    }
}

/// A frame number that occurs twice.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("frame {0} occurs twice, expected at most one pose for a frame")]
pub struct DuplicateFrame(pub u64);

/// Reads a KITTI file.
///
/// # Errors
/// [`TrajectoryError`] with file, line, what was found and what was expected: a wrong or changing number of columns,
/// text that is no number, a matrix that is no rotation, frame numbers that are no integers or do not grow, no pose.
pub fn read(path: &Path) -> Result<KittiPoses, TrajectoryError> {
    parse(&read_text(path)?, path)
}

/// Parses KITTI text; `path` appears in errors only.
///
/// # Errors
/// As [`read`].
pub fn parse(text: &str, path: &Path) -> Result<KittiPoses, TrajectoryError> {
    let mut out = KittiPoses::default();
    for (number, line) in content_lines(text) {
        let fail = |found: String, expected: String| TrajectoryError::Line {
            path: path.into(),
            line: number,
            found,
            expected,
        };
        let fields: Vec<&str> = line.split_ascii_whitespace().collect();
        let indexed = fields.len() == 13;
        if !indexed && fields.len() != 12 {
            let found = format!("{} columns in {}", fields.len(), quoted(line));
            return Err(fail(found, COLUMNS.into()));
        }
        if out.is_empty() {
            out.indexed = indexed;
        } else if out.indexed != indexed {
            let first = if out.indexed { 13 } else { 12 };
            let found = format!("{} columns", fields.len());
            return Err(fail(found, format!("{first} columns as in the first pose")));
        }
        let mut v = [0.0; 13];
        for (value, field) in v.iter_mut().zip(&fields) {
            *value = parse_finite(field).ok_or_else(|| fail(quoted(field), "a finite number".into()))?;
        }
        let (frame, values) = if indexed {
            // 2^53: the largest range in which every integer is an f64.
            if v[0] < 0.0 || v[0].fract() != 0.0 || v[0] > 9_007_199_254_740_992.0 {
                return Err(fail(quoted(fields[0]), "a frame number (an integer from 0)".into()));
            }
            (v[0] as u64, &v[1..])
        } else {
            (out.len() as u64, &v[..12])
        };
        if let Some(last) = out.poses.last().filter(|last| frame <= last.frame) {
            let expected = format!("a number above {}, that of the pose before", last.frame);
            return Err(fail(format!("frame {frame}"), expected));
        }
        let matrix = Matrix3x4::from_row_slice(values);
        let rotation =
            quaternion::from_matrix(&matrix.fixed_view::<3, 3>(0, 0).into_owned(), ROTATION_TOLERANCE)
                .map_err(|e| {
                    fail(e.to_string(), "a rotation in columns 1-3, 5-7, 9-11 of the pose".into())
                })?;
        let translation = Translation3::from(matrix.column(3).into_owned());
        let world_from_camera = Isometry3::from_parts(translation, rotation);
        out.poses.push(KittiPose { frame, matrix, world_from_camera });
    }
    if out.is_empty() {
        return Err(TrajectoryError::Empty { path: path.into(), expected: COLUMNS });
    }
    Ok(out)
}

/// Writes a KITTI file; 13 columns if the poses are [indexed](KittiPoses::is_indexed).
///
/// # Errors
/// [`TrajectoryError::Io`] with the system's reason.
pub fn write(path: &Path, poses: &KittiPoses) -> Result<(), TrajectoryError> {
    write_text(path, &format(poses))
}

/// The poses as KITTI text, every number as the shortest text that reads back to the same `f64`.
pub fn format(poses: &KittiPoses) -> String {
    let mut text = String::with_capacity(poses.len() * 240);
    for pose in poses.poses() {
        // Writing to a String cannot fail.
        if poses.is_indexed() {
            let _ = write!(text, "{} ", pose.frame);
        }
        for (i, v) in pose.matrix.transpose().iter().enumerate() {
            let _ = write!(text, "{}{v}", if i == 0 { "" } else { " " });
        }
        text.push('\n');
    }
    text
}
