//! From files and numbers to recordings: choose, date, pose, calibrate.

use grnet_geometry::Pose;
use std::path::{Path, PathBuf};

use grnet_frame::Camera;

use super::intrinsics::Intrinsics;
use super::listing::{Listed, Listing, PoseOrigin, Set, names};
use super::pose::Invalid;
use super::pose_table::{PoseTable, known, pose_at};
use super::{DatasetError, OpenOptions, RecordedFrame, Recording, seven_scenes, split};

/// How many images are tried for a readable header.
const HEADERS_TRIED: usize = 32;

/// Makes the recordings that the options choose from what a layout reader found.
pub(crate) fn recordings(
    path: &Path,
    mut set: Set,
    options: &OpenOptions,
) -> Result<Vec<Recording>, DatasetError> {
    choose(path, &mut set, options)?;
    let given = options.poses.as_deref().map(|file| given_poses(file, &set, options)).transpose()?;
    let layout = set.layout;
    set.listings
        .into_iter()
        .map(|listing| {
            let Listing { id, name, frames, .. } = &listing;
            let mut notes = listing.notes.clone();
            let mut invalid = Invalid::new(options.invalid_poses);
            invalid.count = given.as_ref().map_or(listing.invalid_poses, |(_, count)| *count);
            let table = given.as_ref().map(|(table, _)| table);
            let mut posed = poses(frames, &listing.poses, table, options, &mut invalid)?;
            times(&mut posed, listing.default_rate_hz, options.rate_hz);
            in_order(name, &posed)?;
            let size = frames
                .iter()
                .take(HEADERS_TRIED)
                .find_map(|frame| Some((frame.path.as_path(), crate::decode::size_px(&frame.path).ok()?)));
            let camera = cameras(&mut posed, &listing, size, options)?;
            note_poses(&mut notes, &posed, invalid.count);
            Ok(Recording {
                name: name.clone(),
                id: id.clone(),
                layout,
                nominal_rate_hz: rate_hz(&posed),
                frames: posed.into_iter().map(Posed::into_frame).collect(),
                camera,
                image_size_px: size.map(|(_, size)| size),
                invalid_poses: invalid.count,
                notes,
            })
        })
        .collect()
}

/// A frame while it is put together.
struct Posed {
    path: PathBuf,
    number: u64,
    time_ns: Option<u64>,
    world_from_camera: Option<Pose>,
    focal_px: Option<f64>,
    camera: Option<Camera>,
}

impl Posed {
    fn into_frame(self) -> RecordedFrame {
        RecordedFrame {
            path: self.path,
            time_ns: self.time_ns.unwrap_or_default(),
            sequence: self.number,
            world_from_camera: self.world_from_camera,
            camera: self.camera,
        }
    }
}

fn choose(path: &Path, set: &mut Set, options: &OpenOptions) -> Result<(), DatasetError> {
    let wanted = |listing: &Listing| options.sequence.as_ref().is_none_or(|id| *id == listing.id);
    if !set.listings.iter().any(wanted) {
        return Err(DatasetError::NoSuchSequence {
            path: path.to_path_buf(),
            sequence: options.sequence.clone().unwrap_or_default(),
            available: names(set.listings.iter().map(|listing| listing.id.as_str())),
        });
    }
    split::apply(set, &options.split)?;
    set.listings.retain(wanted);
    if set.listings.is_empty() {
        return Err(DatasetError::Empty {
            path: path.to_path_buf(),
            expected: format!("the split {:?} has none of the sequence asked for", options.split),
        });
    }
    Ok(())
}

/// The ground truth that the options give, and how many of its poses were impossible.
fn given_poses(file: &Path, set: &Set, options: &OpenOptions) -> Result<(PoseTable, usize), DatasetError> {
    let file = split::locate(file, &set.root);
    let mut invalid = Invalid::new(options.invalid_poses);
    let table = PoseTable::read_any(&file, &mut invalid)?;
    if set.listings.len() > 1 && !matches!(table, PoseTable::Named(_)) {
        return Err(DatasetError::Option {
            option: "poses",
            problem: format!(
                "{} holds one trajectory, but {} sequences are open ({}): choose one with the option `sequence`",
                file.display(),
                set.listings.len(),
                names(set.listings.iter().map(|listing| listing.id.as_str()))
            ),
        });
    }
    Ok((table, invalid.count))
}

fn poses(
    frames: &[Listed],
    origin: &PoseOrigin,
    given: Option<&PoseTable>,
    options: &OpenOptions,
    invalid: &mut Invalid,
) -> Result<Vec<Posed>, DatasetError> {
    let bare = |frame: &Listed| Posed {
        path: frame.path.clone(),
        number: frame.number,
        time_ns: frame.time_ns,
        world_from_camera: None,
        focal_px: None,
        camera: None,
    };
    let mut posed: Vec<Posed> = frames.iter().map(bare).collect();
    match (given, origin) {
        (Some(table), _) => from_table(&mut posed, frames, table, &Pose::identity(), options)?,
        (None, PoseOrigin::Table { table, sensor_from_camera }) => {
            from_table(&mut posed, frames, table, sensor_from_camera, options)?;
        }
        (None, PoseOrigin::BesideImages) => {
            for frame in &mut posed {
                frame.world_from_camera = seven_scenes::pose_beside(&frame.path, invalid)?;
            }
        }
        (None, PoseOrigin::None) => {}
    }
    Ok(posed)
}

fn from_table(
    posed: &mut [Posed],
    frames: &[Listed],
    table: &PoseTable,
    sensor_from_camera: &Pose,
    options: &OpenOptions,
) -> Result<(), DatasetError> {
    let timed = posed.iter().all(|frame| frame.time_ns.is_some());
    match table {
        PoseTable::Timed(rows) if timed => {
            let rows = known(rows);
            for frame in &mut *posed {
                let time_ns = frame.time_ns.unwrap_or_default();
                frame.world_from_camera = pose_at(&rows, time_ns, options.association);
            }
        }
        PoseTable::Timed(rows) if rows.len() == posed.len() => {
            for (frame, (time_ns, pose)) in posed.iter_mut().zip(rows) {
                (frame.time_ns, frame.world_from_camera) = (Some(*time_ns), *pose);
            }
        }
        PoseTable::Timed(rows) => {
            return Err(DatasetError::Option {
                option: "poses",
                problem: format!(
                    "the trajectory has {} poses by time, but the {} images have no times: name the images by \
                     their time, or give one pose for each",
                    rows.len(),
                    posed.len()
                ),
            });
        }
        PoseTable::Numbered(by_number) => {
            for frame in &mut *posed {
                frame.world_from_camera = by_number.get(&frame.number).copied();
            }
        }
        PoseTable::Named(by_name) => {
            for (frame, listed) in posed.iter_mut().zip(frames) {
                if let Some((pose, focal_px)) = by_name.get(&listed.key) {
                    (frame.world_from_camera, frame.focal_px) = (Some(*pose), *focal_px);
                }
            }
        }
    }
    for frame in posed {
        frame.world_from_camera = frame.world_from_camera.map(|pose| pose * sensor_from_camera);
    }
    Ok(())
}

/// Dates the frames that have no time, or all of them when a rate is given.
fn times(posed: &mut [Posed], default_rate_hz: f64, given_rate_hz: Option<f64>) {
    for frame in posed {
        if given_rate_hz.is_some() || frame.time_ns.is_none() {
            let rate_hz = given_rate_hz.unwrap_or(default_rate_hz);
            frame.time_ns = Some((frame.number as f64 * (1e9 / rate_hz)).round() as u64);
        }
    }
}

fn in_order(name: &str, posed: &[Posed]) -> Result<(), DatasetError> {
    for pair in posed.windows(2) {
        if pair[1].time_ns < pair[0].time_ns || pair[1].number <= pair[0].number {
            return Err(DatasetError::Order { name: name.into(), image: pair[1].path.clone() });
        }
    }
    Ok(())
}

/// The recording's camera; frames whose ground truth gives another focal length get one of their own.
fn cameras(
    posed: &mut [Posed],
    listing: &Listing,
    image: Option<(&Path, (u32, u32))>,
    options: &OpenOptions,
) -> Result<Option<Camera>, DatasetError> {
    if let Some(camera) = &options.camera {
        return Intrinsics::of(camera, "the option `camera`").camera(image);
    }
    let first_focal_px = posed.iter().find_map(|frame| frame.focal_px);
    let Some(focal_px) = first_focal_px else {
        return listing.intrinsics.as_ref().map_or(Ok(None), |intrinsics| intrinsics.camera(image));
    };
    let with_focal = |focal_px| Intrinsics::with_focal(focal_px, "the ground truth list").camera(image);
    for frame in posed.iter_mut() {
        if let Some(own_px) = frame.focal_px.filter(|own_px| *own_px != focal_px) {
            frame.camera = with_focal(own_px)?;
        }
    }
    with_focal(focal_px)
}

/// Frames per second by the middle one of all intervals.
fn rate_hz(posed: &[Posed]) -> Option<f64> {
    let time_ns = |frame: &Posed| frame.time_ns.unwrap_or_default();
    let mut intervals_ns: Vec<u64> =
        posed.windows(2).map(|pair| time_ns(&pair[1]) - time_ns(&pair[0])).filter(|ns| *ns > 0).collect();
    intervals_ns.sort_unstable();
    intervals_ns.get(intervals_ns.len() / 2).map(|ns| 1e9 / *ns as f64)
}

fn note_poses(notes: &mut Vec<String>, posed: &[Posed], invalid: usize) {
    let missing = posed.iter().filter(|frame| frame.world_from_camera.is_none()).count();
    if missing == posed.len() {
        notes.push("no ground truth".into());
    } else if missing > 0 {
        notes.push(format!("{missing} of {} frames have no ground truth", posed.len()));
    }
    if invalid > 0 {
        notes.push(format!("{invalid} ground-truth poses are no rigid motions and were left out"));
    }
}
