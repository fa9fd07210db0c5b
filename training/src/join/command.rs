//! `grnet-train join`.

use std::path::{Path, PathBuf};

use clap::Args;
use grnet_capture::dataset::{self, Pose};
use grnet_geometry::quaternion;
use grnet_geometry::trajectory::tum;
use nalgebra::{Translation3, Vector3};

use super::{Gravity, JoinReport, Scale, Transform, apply, by_name, by_time, target, write};
use crate::dataset_args::FrameArgs;

/// Give a recording ground truth from a trajectory: motion capture, another SLAM system, or COLMAP.
///
/// Poses are carried to the frames by time (a TUM file `time_s tx ty tz qx qy qz qw`, interpolated) or by image name
/// (a COLMAP text model), and written where the recording's reader looks for them.
#[derive(Debug, Args)]
pub struct JoinArgs {
    /// Folder of the recording.
    #[arg(value_name = "RECORDING")]
    pub data: PathBuf,
    /// How the folder is read.
    #[command(flatten)]
    pub frames: FrameArgs,
    /// TUM file, or the folder of a COLMAP text model (cameras.txt, images.txt).
    #[arg(long, value_name = "FILE|DIR")]
    pub trajectory: PathBuf,
    /// Added to the trajectory's times.
    #[arg(long, value_name = "SECONDS", default_value_t = 0.0, allow_hyphen_values = true)]
    pub time_offset: f64,
    /// Longest time between two poses that is interpolated over.
    #[arg(long, value_name = "SECONDS", default_value_t = 0.1)]
    pub max_gap: f64,
    /// Pose of the camera (x right, y down, z forward) in the tracked body: x,y,z,qx,qy,qz,qw in metres
    /// [default: the camera itself is tracked].
    #[arg(long, value_name = "POSE", value_parser = parse_pose, allow_hyphen_values = true)]
    pub body_from_camera: Option<Pose>,
    /// Metres per unit of the trajectory.
    #[arg(long, value_name = "FACTOR", conflicts_with_all = ["scale_between", "reference"])]
    pub scale: Option<f64>,
    /// Scale from a measured distance between the camera's places at two frames, by their numbers.
    #[arg(long, value_name = "FRAME,FRAME,METRES", value_parser = parse_between, conflicts_with = "reference")]
    pub scale_between: Option<(u64, u64, f64)>,
    /// Scale and world from a metric trajectory of the same drive (TUM file), by least squares over the positions.
    #[arg(long, value_name = "FILE")]
    pub reference: Option<PathBuf>,
    /// Added to the reference's times.
    #[arg(long, value_name = "SECONDS", requires = "reference", allow_hyphen_values = true)]
    pub reference_time_offset: Option<f64>,
    /// Turn the world so that z points up: `camera` takes the mean of the cameras' y axes for down, x,y,z is down in
    /// the trajectory's world.
    #[arg(long, value_name = "camera|X,Y,Z", value_parser = parse_gravity, conflicts_with = "reference",
          allow_hyphen_values = true)]
    pub gravity: Option<Gravity>,
    /// File to write [default: groundtruth.txt in the recording].
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// Replace the ground truth that is there.
    #[arg(long)]
    pub force: bool,
    /// Print the report as JSON.
    #[arg(long)]
    pub json: bool,
}

/// Runs the command.
///
/// # Errors
/// When recording or trajectory cannot be read, they do not fit together, or the result cannot be written.
pub fn run(args: &JoinArgs) -> anyhow::Result<()> {
    // Not the folder's own ground truth, which may be what is to be replaced.
    let recording = dataset::open_one(&args.data, &args.frames.open_options())?;
    let target = target(&args.data, &recording, args.out.as_deref(), args.force)?;
    let max_gap_ns = nanoseconds("--max-gap", args.max_gap)?;
    let offset_ns = nanoseconds("--time-offset", args.time_offset)?;
    let matched = match colmap_model(&args.trajectory) {
        Some(model) if args.time_offset == 0.0 => by_name(&recording.frames, &model)?,
        Some(_) => {
            anyhow::bail!("--time-offset: a COLMAP model is joined by name and has no times; leave it out")
        }
        None => by_time(&recording.frames, &tum::read(&args.trajectory)?, offset_ns, max_gap_ns)?,
    };
    let transform = Transform {
        scale: args.scale(max_gap_ns)?,
        body_from_camera: args.body_from_camera.unwrap_or_else(Pose::identity),
        gravity: args.gravity,
    };
    let (poses, report) = apply(&recording.frames, &matched, &transform)?;
    let name = args.trajectory.file_name().unwrap_or_default().to_string_lossy();
    write(&target, &name, &recording.frames, &poses)?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(&report)?);
    } else {
        print!("{}", text(&report));
        println!("written           {}", target.path().display());
    }
    Ok(())
}

impl JoinArgs {
    fn scale(&self, max_gap_ns: i64) -> anyhow::Result<Scale> {
        if let Some(file) = &self.reference {
            return Ok(Scale::Reference {
                trajectory: tum::read(file)?,
                time_offset_ns: nanoseconds(
                    "--reference-time-offset",
                    self.reference_time_offset.unwrap_or_default(),
                )?,
                max_gap_ns,
            });
        }
        if let Some((first, second, distance_m)) = self.scale_between {
            return Ok(Scale::Between { first, second, distance_m });
        }
        match self.scale.unwrap_or(1.0) {
            factor if factor.is_finite() && factor > 0.0 => Ok(Scale::Factor(factor)),
            factor => anyhow::bail!("--scale: found {factor}, expected a positive number"),
        }
    }
}

/// The folder of a COLMAP model: a folder, or the `images.txt` in it.
fn colmap_model(trajectory: &Path) -> Option<PathBuf> {
    if trajectory.is_dir() {
        return Some(trajectory.to_path_buf());
    }
    let is_model = trajectory.file_name().is_some_and(|name| name == "images.txt");
    is_model.then(|| trajectory.parent().unwrap_or(Path::new(".")).to_path_buf())
}

fn nanoseconds(option: &str, seconds: f64) -> anyhow::Result<i64> {
    let ns = (seconds * 1e9).round();
    if ns.is_finite() && ns.abs() < 9e18 {
        Ok(ns as i64)
    } else {
        anyhow::bail!("{option}: found {seconds}, expected seconds")
    }
}

fn text(report: &JoinReport) -> String {
    let mut text = String::new();
    let mut line = |name: &str, value: String| text += &format!("{name:<18}{value}\n");
    line("frames", format!("{} of {} got a pose", report.with_pose, report.frames));
    let reasons = [
        (report.outside, "before the first or after the last pose"),
        (report.in_gaps, "in gaps longer than --max-gap"),
        (report.unnamed, "not in the model"),
    ];
    for (count, why) in reasons.into_iter().filter(|(count, _)| *count > 0) {
        line("", format!("{count} {why}"));
    }
    if !report.without_pose.is_empty() {
        let run = |(first, last): &(u64, u64)| {
            if first == last { first.to_string() } else { format!("{first}-{last}") }
        };
        let mut runs: Vec<String> = report.without_pose.iter().take(8).map(run).collect();
        if report.without_pose.len() > 8 {
            runs.push(format!("... {} runs in all", report.without_pose.len()));
        }
        line("without pose", runs.join(", "));
    }
    if let Some(gap_s) = report.largest_gap_s {
        line("largest gap", format!("{gap_s:.4} s between two poses"));
    }
    line("scale", format!("{:.6} m per unit", report.scale));
    if let Some(residuals) = &report.reference {
        line(
            "reference",
            format!(
                "{} positions, {:.4} m root mean square, {:.4} m at most",
                residuals.pairs, residuals.rms_m, residuals.max_m
            ),
        );
    }
    if let Some(turned_deg) = report.turned_deg {
        line("turned", format!("{turned_deg:.2} deg to have z up"));
    }
    line("path", format!("{:.3} m", report.path_m));
    text
}

fn parse_numbers<const N: usize>(text: &str) -> Option<[f64; N]> {
    let numbers: Vec<f64> = text
        .split([',', ' '])
        .filter(|part| !part.is_empty())
        .map(str::parse)
        .collect::<Result<_, _>>()
        .ok()?;
    let numbers: [f64; N] = numbers.try_into().ok()?;
    numbers.iter().all(|number| number.is_finite()).then_some(numbers)
}

fn parse_pose(text: &str) -> Result<Pose, String> {
    let Some([x, y, z, qx, qy, qz, qw]) = parse_numbers(text) else {
        return Err("expected seven numbers x,y,z,qx,qy,qz,qw".into());
    };
    let norm = [qx, qy, qz, qw].iter().map(|q| q * q).sum::<f64>().sqrt();
    if (norm - 1.0).abs() > 0.01 {
        return Err(format!("the quaternion has length {norm:.3}, expected 1"));
    }
    let rotation = quaternion::from_xyzw([qx, qy, qz, qw]).map_err(|error| error.to_string())?;
    Ok(Pose::from_parts(Translation3::new(x, y, z), rotation))
}

fn parse_between(text: &str) -> Result<(u64, u64, f64), String> {
    let parts: Vec<&str> = text.split(',').collect();
    let parsed = match parts.as_slice() {
        [first, second, metres] => {
            let metres = metres.parse().ok().filter(|m: &f64| m.is_finite() && *m > 0.0);
            first.parse().ok().zip(second.parse().ok()).zip(metres)
        }
        _ => None,
    };
    let ((first, second), metres) =
        parsed.ok_or("expected two frame numbers and a distance in metres, such as 0,250,3.2")?;
    Ok((first, second, metres))
}

fn parse_gravity(text: &str) -> Result<Gravity, String> {
    if text == "camera" {
        return Ok(Gravity::Camera);
    }
    let [x, y, z] = parse_numbers(text).ok_or("expected `camera` or three numbers x,y,z")?;
    Ok(Gravity::Down(Vector3::new(x, y, z)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_on_the_command_line_are_read_or_named() {
        let pose = parse_pose("0.1,-2,3 0 0 0 1").unwrap();
        assert_eq!(pose.translation.vector.as_slice(), [0.1, -2.0, 3.0]);
        assert!(parse_pose("1,2,3").unwrap_err().contains("seven"));
        assert!(parse_pose("0,0,0,1,1,0,0").unwrap_err().contains("length 1.414"));
        assert_eq!(parse_between("3,40,2.5"), Ok((3, 40, 2.5)));
        assert!(parse_between("3,40,-1").is_err() && parse_between("3,40").is_err());
        assert_eq!(parse_gravity("camera"), Ok(Gravity::Camera));
        assert_eq!(parse_gravity("0,0,-9.81"), Ok(Gravity::Down(Vector3::new(0.0, 0.0, -9.81))));
        assert!(parse_gravity("down").is_err());
    }
}
