//! Scores of the trajectories in `golden/` against what evo, the KITTI devkit and kitti-odom-eval give for them
//! (`golden/golden.json`, written by `golden/generate.py`).

mod support;

use std::path::PathBuf;

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
use support::{Ledger, both_or_neither, compare_odom_eval, number, select};

fn folder() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/golden")
}

fn cases(format: &str) -> Vec<(String, Value)> {
    let text = std::fs::read_to_string(folder().join("golden.json")).unwrap();
    let golden: Value = serde_json::from_str(&text).unwrap();
    let all = golden["cases"].as_object().unwrap().clone();
    all.into_iter().filter(|(_, case)| case["format"] == format).collect()
}

fn file(case: &Value, which: &str) -> PathBuf {
    folder().join(case[which].as_str().unwrap())
}

fn kitti_pair(case: &Value) -> (KittiPoses, KittiPoses) {
    let read = |which| trajectory::kitti::read(&file(case, which)).unwrap();
    (read("reference"), read("estimate"))
}

/// Lengths (m) below which a figure is rounding noise of f64.
const ROUNDING_M: f64 = 1e-9;

/// Lengths (m) below which a figure of a KITTI file depends on the last printed digit: evo multiplies the printed
/// matrices, here they are projected to rotations first.
const PRINTED_M: f64 = 1e-6;

/// Absolute and relative errors under every alignment, as `generate.py` names them.
fn compare_evo(
    ledger: &mut Ledger,
    name: &str,
    reference: &[Pose],
    estimate: &[Pose],
    theirs: &Value,
    floor_m: f64,
) {
    assert_eq!(reference.len() as u64, theirs["count"].as_u64().unwrap(), "{name}: number of pairs");
    let metres = Delta::Metres(number(&theirs["metres"]));
    let default = RpeOptions::default();
    let relative = [
        ("rpe_1_frame", default),
        ("rpe_7_frames", RpeOptions { delta: Delta::Frames(7), ..default }),
        ("rpe_7_frames_all", RpeOptions { delta: Delta::Frames(7), all_pairs: true, ..default }),
        ("rpe_metres", RpeOptions { delta: metres, ..default }),
        ("rpe_metres_all", RpeOptions { delta: metres, all_pairs: true, ..default }),
        ("rpe_metres_reference", RpeOptions { delta: metres, pairs_from_reference: true, ..default }),
    ];
    for (key, alignment) in [
        ("none", Alignment::None),
        ("se3", Alignment::Se3),
        ("sim3", Alignment::Sim3),
        ("scale", Alignment::Scale),
    ] {
        let what = format!("{name} {key}");
        let theirs = &theirs[key];
        let absolute = ate::score(reference, estimate, alignment);
        let Some(absolute) = both_or_neither(&what, absolute, theirs) else { continue };
        ledger.compare("evo", &format!("{what} scale"), absolute.scale, number(&theirs["scale"]), 0.0);
        let ape = &theirs["ape"];
        ledger.statistics(
            "evo",
            &format!("{what} ape"),
            &absolute.translation_m,
            &ape["translation_m"],
            1e-9,
        );
        ledger.statistics("evo", &format!("{what} ape"), &absolute.rotation_deg, &ape["rotation_deg"], 1e-6);

        let similarity = alignment.solve(estimate, reference).unwrap();
        let moved: Vec<Pose> = estimate.iter().map(|p| similarity.apply(p)).collect();
        for (key, options) in relative {
            let what = format!("{what} {key}");
            let theirs = &theirs[key];
            let ours = rpe::score(reference, &moved, &options);
            let Some(ours) = both_or_neither(&what, ours, &theirs["translation_m"]) else { continue };
            ledger.statistics("evo", &what, &ours.translation_m, &theirs["translation_m"], floor_m);
            ledger.statistics("evo", &what, &ours.rotation_deg, &theirs["rotation_deg"], 1e-6);
        }
    }
}

#[test]
fn tum_trajectories_score_as_with_evo() {
    let mut ledger = Ledger::new(1e-6);
    for (name, case) in cases("tum") {
        let (reference, estimate) =
            (tum::read(&file(&case, "reference")).unwrap(), tum::read(&file(&case, "estimate")).unwrap());
        let nanoseconds = |key: &str| (number(&case[key]) * 1e9).round() as i64;
        let options = AssociationOptions {
            max_difference_ns: nanoseconds("max_difference_s"),
            estimate_offset_ns: nanoseconds("offset_s"),
            one_to_one: false,
        };
        let association = trajectory::associate(&reference, &estimate, &options).unwrap();
        let reference = select(&reference, association.pairs.iter().map(|p| p.0));
        let estimate = select(&estimate, association.pairs.iter().map(|p| p.1));
        compare_evo(&mut ledger, &name, &reference, &estimate, &case["evo"], ROUNDING_M);
    }
    ledger.finish(1500);
}

#[test]
fn kitti_trajectories_score_as_with_evo() {
    let mut ledger = Ledger::new(1e-5);
    for (name, case) in cases("kitti").iter().filter(|(_, case)| case.get("evo").is_some()) {
        let (truth, estimate) = kitti_pair(case);
        let poses = |p: &KittiPoses| p.poses().iter().map(|p| p.world_from_camera).collect::<Vec<_>>();
        compare_evo(&mut ledger, name, &poses(&truth), &poses(&estimate), &case["evo"], PRINTED_M);
    }
    ledger.finish(700);
}

#[test]
fn segments_score_as_with_kitti_odom_eval() {
    let mut ledger = Ledger::new(1e-6);
    for (name, case) in cases("kitti") {
        let (truth, estimate) = kitti_pair(&case);
        compare_odom_eval(&mut ledger, &name, &truth, &estimate, &case["kitti_odom_eval"]);
    }
    ledger.finish(60);
}

#[test]
fn segments_score_as_with_the_devkit() {
    let mut ledger = Ledger::new(1e-4);
    for (name, case) in cases("kitti").iter().filter(|(_, case)| case.get("devkit").is_some()) {
        let (truth, estimate) = kitti_pair(case);
        let score = kitti::score(&truth, &estimate, kitti::Arithmetic::Devkit).unwrap();
        let theirs = &case["devkit"];
        let mut row = |what: String, ours: kitti::Mean, theirs: &Value| {
            assert_eq!(ours.segments as u64, theirs["segments"].as_u64().unwrap(), "{what}");
            let (t, r) =
                (number(&theirs["t_err"]) * 100.0, number(&theirs["r_err_rad_per_m"]).to_degrees() * 100.0);
            ledger.compare("devkit", &format!("{name} {what} t_rel"), ours.t_rel_percent, t, 0.0);
            ledger.compare("devkit", &format!("{name} {what} r_rel"), ours.r_rel_deg_per_100m, r, 0.0);
        };
        row("overall".into(), score.overall.unwrap(), &theirs["overall"]);
        assert_eq!(score.per_length.len(), theirs["per_length"].as_object().unwrap().len());
        for ours in &score.per_length {
            row(format!("{} m", ours.length_m), ours.mean, &theirs["per_length"][ours.length_m.to_string()]);
        }
        assert_eq!(score.per_speed.len(), theirs["per_speed"].as_object().unwrap().len());
        for ours in &score.per_speed {
            row(
                format!("{} m/s", ours.speed_mps),
                ours.mean,
                &theirs["per_speed"][ours.speed_mps.to_string()],
            );
        }
    }
    ledger.finish(60);
}
