//! KITTI and TUM trajectories against the figures of the public tools.
//!
//! The trajectories are other people's data and not part of this repository: the tests look in `GRNET_DATA`, then in
//! `../shared/data` beside the repository, and say that they skipped when there is nothing.

mod support;

use std::path::{Path, PathBuf};

use grnet_geometry::{
    Pose,
    align::Alignment,
    scores::{
        ate, kitti,
        rpe::{self, Delta, RpeOptions},
    },
    trajectory::{self, AssociationOptions, KittiPoses, tum},
};
use serde_json::Value;
use support::{Ledger, compare_odom_eval, number, select};

fn data(folder: &str) -> Option<PathBuf> {
    let root = std::env::var_os("GRNET_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data"), PathBuf::from);
    let found = Some(root.join("trajectories").join(folder)).filter(|p| p.is_dir());
    if found.is_none() {
        println!("SKIPPED: no trajectories/{folder} in {} (set GRNET_DATA)", root.display());
    }
    found
}

fn results(file: &Path) -> Value {
    let document: Value = serde_json::from_str(&std::fs::read_to_string(file).unwrap()).unwrap();
    document["results"].clone()
}

fn kitti_pair(root: &Path, method: &str, sequence: &str) -> (KittiPoses, KittiPoses) {
    let read = |path: PathBuf| trajectory::kitti::read(&path).unwrap();
    (
        read(root.join("gt").join(format!("{sequence}.txt"))),
        read(root.join("methods").join(method).join(format!("{sequence}.txt"))),
    )
}

/// Lengths (m) below which a figure is rounding noise of f64.
const ROUNDING_M: f64 = 1e-9;

/// Lengths (m) below which a figure of a KITTI file depends on the last printed digit: evo multiplies the printed
/// matrices, here they are projected to rotations first.
const PRINTED_M: f64 = 1e-6;

fn compare_evo(
    ledger: &mut Ledger,
    name: &str,
    reference: &[Pose],
    estimate: &[Pose],
    theirs: &Value,
    floor_m: f64,
) {
    assert_eq!(reference.len() as u64, theirs["n"].as_u64().unwrap(), "{name}: number of pairs");
    for (key, alignment) in [
        ("none", Alignment::None),
        ("align_se3", Alignment::Se3),
        ("align_sim3", Alignment::Sim3),
        ("scale_only", Alignment::Scale),
    ] {
        let theirs = &theirs[key];
        let absolute = ate::score(reference, estimate, alignment).unwrap();
        let similarity = alignment.solve(estimate, reference).unwrap();
        let moved: Vec<Pose> = estimate.iter().map(|p| similarity.apply(p)).collect();
        let frame = rpe::score(reference, &moved, &RpeOptions::default()).unwrap();
        let mut check = |what: &str, ours, floor| {
            ledger.statistics("evo", &format!("{name} {key} {what}"), ours, &theirs[what], floor);
        };
        check("ape_translation_part", &absolute.translation_m, floor_m);
        check("ape_rotation_angle_deg", &absolute.rotation_deg, 1e-6);
        check("rpe1f_translation_part", &frame.translation_m, floor_m);
        check("rpe1f_rotation_angle_deg", &frame.rotation_deg, 1e-6);
        if theirs.get("rpe100m_allpairs_translation_part").is_some() {
            let options =
                RpeOptions { delta: Delta::Metres(100.0), all_pairs: true, ..RpeOptions::default() };
            let metres = rpe::score(reference, &moved, &options).unwrap();
            check("rpe100m_allpairs_translation_part", &metres.translation_m, floor_m);
        }
    }
}

#[test]
fn kitti_as_with_evo() {
    let Some(root) = data("kitti") else { return };
    let mut ledger = Ledger::new(1e-4);
    for (name, theirs) in results(&root.join("reference_evo.json")).as_object().unwrap() {
        // "kitti09_example_1", "kitti04_turtle_orb"
        let (sequence, method) = name.strip_prefix("kitti").and_then(|n| n.split_once('_')).unwrap();
        let method = match method {
            "turtle_orb" => "turtlezhong_ORB".to_owned(),
            other => format!("kitti-odom-eval_{other}"),
        };
        let (truth, estimate) = kitti_pair(&root, &method, sequence);
        let poses = |p: &KittiPoses| p.poses().iter().map(|p| p.world_from_camera).collect::<Vec<_>>();
        compare_evo(&mut ledger, name, &poses(&truth), &poses(&estimate), theirs, PRINTED_M);
    }
    ledger.finish(900);
}

#[test]
fn tum_as_with_evo() {
    let Some(root) = data("tum") else { return };
    let mut ledger = Ledger::new(1e-4);
    for (name, theirs) in results(&root.join("reference_evo.json")).as_object().unwrap() {
        let file = name.strip_prefix("tum_").unwrap();
        let estimate = root.join(format!("{file}.txt"));
        if !estimate.exists() {
            println!("SKIPPED: {name}: the data set lacks {}", estimate.display());
            continue;
        }
        let reference = tum::read(&root.join("freiburg1_xyz-groundtruth.txt")).unwrap();
        let estimate = tum::read(&estimate).unwrap();
        let options = AssociationOptions::default();
        let association = trajectory::associate(&reference, &estimate, &options).unwrap();
        let reference = select(&reference, association.pairs.iter().map(|p| p.0));
        let estimate = select(&estimate, association.pairs.iter().map(|p| p.1));
        compare_evo(&mut ledger, name, &reference, &estimate, theirs, ROUNDING_M);
    }
    ledger.finish(200);
}

#[test]
fn kitti_as_with_kitti_odom_eval() {
    let Some(root) = data("kitti") else { return };
    let mut ledger = Ledger::new(1e-4);
    for (method, alignments) in results(&root.join("reference_kitti_odom_eval.json")).as_object().unwrap() {
        for sequence in alignments["none"].as_object().unwrap().keys() {
            let (truth, estimate) = kitti_pair(&root, method, sequence);
            let theirs: serde_json::Map<_, _> = alignments
                .as_object()
                .unwrap()
                .iter()
                .map(|(alignment, sequences)| (alignment.clone(), sequences[sequence].clone()))
                .collect();
            let name = format!("{method} {sequence}");
            compare_odom_eval(&mut ledger, &name, &truth, &estimate, &Value::Object(theirs));
        }
    }
    ledger.finish(200);
}

#[test]
fn kitti_as_with_the_devkit() {
    let Some(root) = data("kitti") else { return };
    let mut ledger = Ledger::new(1e-4);
    for (method, sequences) in results(&root.join("reference_kitti_devkit.json")).as_object().unwrap() {
        for (sequence, theirs) in sequences.as_object().unwrap() {
            let (truth, estimate) = kitti_pair(&root, method, sequence);
            let score = kitti::score(&truth, &estimate, kitti::Arithmetic::Devkit).unwrap();
            let overall = score.overall.unwrap();
            let name = format!("{method} {sequence}");
            assert_eq!(overall.segments as u64, theirs["n_segments"].as_u64().unwrap(), "{name}");
            let t = number(&theirs["t_rel_percent"]);
            ledger.compare("devkit", &format!("{name} t_rel"), overall.t_rel_percent, t, 0.0);
            let r = number(&theirs["r_rel_deg_per_100m"]);
            ledger.compare("devkit", &format!("{name} r_rel"), overall.r_rel_deg_per_100m, r, 0.0);
            for row in &score.per_length {
                let theirs = &theirs["per_length"][row.length_m.to_string()];
                assert_eq!(
                    row.mean.segments as u64,
                    theirs[0].as_u64().unwrap(),
                    "{name} {} m",
                    row.length_m
                );
                let what = format!("{name} {} m", row.length_m);
                ledger.compare(
                    "devkit",
                    &format!("{what} t_rel"),
                    row.mean.t_rel_percent,
                    number(&theirs[1]),
                    0.0,
                );
                let r = row.mean.r_rel_deg_per_100m;
                ledger.compare("devkit", &format!("{what} r_rel"), r, number(&theirs[2]), 0.0);
            }
            // In f64 the angle of the straightest sequence differs by less than the printed digits.
            let double = kitti::score(&truth, &estimate, kitti::Arithmetic::Double).unwrap().overall.unwrap();
            assert!(
                (double.t_rel_percent - t).abs() < 1e-4
                    && (double.r_rel_deg_per_100m - r_of(theirs)).abs() < 1e-4
            );
        }
    }
    ledger.finish(150);
}

fn r_of(theirs: &Value) -> f64 {
    number(&theirs["r_rel_deg_per_100m"])
}
