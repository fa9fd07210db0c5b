#!/usr/bin/env python3
"""Writes the synthetic trajectories of this folder and the figures that the public tools give for them.

    python generate.py --kitti-odom-eval DIR --devkit DIR

needs a Python with `evo` and `numpy` (and `matplotlib`, which kitti-odom-eval imports), a checkout of
Huangying-Zhan/kitti-odom-eval, the C++ sources of the KITTI odometry devkit (evaluate_odometry.cpp, matrix.cpp,
matrix.h) and g++. The tools run unmodified; `golden.json` holds what they return.
"""

import argparse
import copy
import json
import pathlib
import subprocess
import sys
import tempfile

import numpy as np
from evo import EvoException
from evo import __version__ as evo_version
from evo.core import lie_algebra as lie
from evo.core import metrics, sync
from evo.core.units import Unit
from evo.tools import file_interface
from scipy.spatial.transform import Rotation

HERE = pathlib.Path(__file__).resolve().parent
RNG = np.random.default_rng(20240611)

# The devkit's mailer is replaced: it differs between copies and plays no part in the errors.
HARNESS = r"""
#include <cstdint>
#define MAIL_H
struct Mail {
  Mail(...) {}
  void msg(...) {}
  void finalize(...) {}
};
#define main devkit_main
#include "evaluate_odometry.cpp"
#undef main
static void print(vector<errors> err) {
  float t = 0, r = 0, n = err.size();
  for (auto &e : err) { t += e.t_err; r += e.r_err; }
  printf("{\"segments\":%d,\"t_err\":%.9g,\"r_err_rad_per_m\":%.9g}", (int)err.size(), t / n, r / n);
}
int main(int, char **argv) {
  vector<Matrix> gt = loadPoses(argv[1]), est = loadPoses(argv[2]);
  vector<errors> err = calcSequenceErrors(gt, est);
  printf("{\"overall\":"); print(err);
  printf(",\"per_length\":{");
  for (int i = 0; i < num_lengths; i++) {
    vector<errors> part;
    for (auto &e : err) if (fabs(e.len - lengths[i]) < 1.0) part.push_back(e);
    if (part.empty()) continue;
    printf("%s\"%d\":", i ? "," : "", (int)lengths[i]); print(part);
  }
  printf("},\"per_speed\":{");
  bool comma = false;
  for (float speed = 2; speed < 25; speed += 2) {
    vector<errors> part;
    for (auto &e : err) if (fabs(e.speed - speed) < 2.0) part.push_back(e);
    if (part.size() < 3) continue;
    printf("%s\"%d\":", comma ? "," : "", (int)speed); print(part);
    comma = true;
  }
  printf("}}\n");
}
"""


def drive(n, step, wobble, turn):
    """A smooth drive: `n` poses about `step` metres apart, heading along z."""
    poses = [np.eye(4)]
    for i in range(1, n):
        yaw = turn * np.sin(i / 23.0)
        motion = np.eye(4)
        motion[:3, :3] = Rotation.from_rotvec([wobble * np.sin(i / 7.0), yaw, wobble * np.cos(i / 11.0)]).as_matrix()
        motion[:3, 3] = [0.0, 0.01 * np.sin(i / 5.0), step * (1.0 + 0.6 * np.sin(i / 40.0))]
        poses.append(poses[-1] @ motion)
    return np.array(poses)


def noisy(poses, drift_m, drift_rad, scale):
    """An odometry estimate: relative motions with noise and a scale error."""
    out = [np.eye(4)]
    for a, b in zip(poses, poses[1:]):
        motion = np.linalg.inv(a) @ b
        motion[:3, :3] = motion[:3, :3] @ Rotation.from_rotvec(RNG.normal(0, drift_rad, 3)).as_matrix()
        motion[:3, 3] = motion[:3, 3] * scale + RNG.normal(0, drift_m, 3)
        out.append(out[-1] @ motion)
    return np.array(out)


def write_kitti(name, poses, frames=None):
    with open(HERE / name, "w") as f:
        for i, pose in enumerate(poses):
            numbers = " ".join(f"{v:.7e}" for v in pose[:3].ravel())
            f.write((f"{frames[i]} " if frames is not None else "") + numbers + "\n")


def write_tum(name, times, poses):
    with open(HERE / name, "w") as f:
        f.write("# timestamp tx ty tz qx qy qz qw\n")
        for t, pose in zip(times, poses):
            q = Rotation.from_matrix(pose[:3, :3]).as_quat()
            f.write(f"{t:.6f} " + " ".join(f"{v:.7f}" for v in [*pose[:3, 3], *q]) + "\n")


def statistics(metric, pair):
    metric.process_data(pair)
    return {"count": len(metric.error), **{k: float(v) for k, v in metric.get_all_statistics().items()}}


def or_error(compute):
    try:
        return compute()
    except EvoException as error:
        return {"error": str(error)}


RELATIVE = {
    "rpe_1_frame": dict(delta=1, delta_unit=Unit.frames),
    "rpe_7_frames": dict(delta=7, delta_unit=Unit.frames),
    "rpe_7_frames_all": dict(delta=7, delta_unit=Unit.frames, all_pairs=True),
    "rpe_metres": dict(delta_unit=Unit.meters),
    "rpe_metres_all": dict(delta_unit=Unit.meters, all_pairs=True),
    "rpe_metres_reference": dict(delta_unit=Unit.meters, pairs_from_reference=True),
}


def evo_figures(reference, estimate, metres):
    relations = {
        "translation_m": metrics.PoseRelation.translation_part,
        "rotation_deg": metrics.PoseRelation.rotation_angle_deg,
    }
    out = {"count": reference.num_poses, "metres": metres}
    for name, arguments in {
        "none": None,
        "se3": {},
        "sim3": {"correct_scale": True},
        "scale": {"correct_only_scale": True},
    }.items():
        moved = copy.deepcopy(estimate)
        try:
            scale = float(moved.align(reference, **arguments)[2]) if arguments is not None else 1.0
        except EvoException as error:
            out[name] = {"error": str(error)}
            continue
        out[name] = {"scale": scale}
        for part, relation in relations.items():
            absolute = or_error(lambda: statistics(metrics.APE(relation), (reference, moved)))
            out[name].setdefault("ape", {})[part] = absolute
            for key, options in RELATIVE.items():
                options = {"delta": metres, **options}
                relative = or_error(lambda: statistics(metrics.RPE(relation, **options), (reference, moved)))
                out[name].setdefault(key, {})[part] = relative
    return out


def tum_case(reference, estimate, metres, max_diff=0.01, offset=0.0):
    a = file_interface.read_tum_trajectory_file(HERE / reference)
    b = file_interface.read_tum_trajectory_file(HERE / estimate)
    a, b = sync.associate_trajectories(a, b, max_diff=max_diff, offset_2=offset)
    return {
        "format": "tum",
        "reference": reference,
        "estimate": estimate,
        "max_difference_s": max_diff,
        "offset_s": offset,
        "evo": evo_figures(a, b, metres),
    }


def kitti_case(reference, estimate, metres, tools):
    a = file_interface.read_kitti_poses_file(HERE / reference)
    b = file_interface.read_kitti_poses_file(HERE / estimate)
    return {
        "format": "kitti",
        "reference": reference,
        "estimate": estimate,
        "evo": evo_figures(a, b, metres),
        "devkit": tools.devkit(HERE / reference, HERE / estimate),
        "kitti_odom_eval": tools.odom_eval(reference, estimate),
    }


class Tools:
    def __init__(self, odom_eval, devkit, scratch):
        sys.path.insert(0, str(odom_eval))
        from kitti_odometry import KittiEvalOdom, scale_lse_solver, umeyama_alignment

        self.tool = KittiEvalOdom()
        self.scale_lse, self.umeyama = scale_lse_solver, umeyama_alignment
        source = scratch / "harness.cpp"
        source.write_text(HARNESS)
        self.binary = scratch / "harness"
        sources = [source, devkit / "matrix.cpp"]
        subprocess.run(["g++", "-O2", "-w", f"-I{devkit}", *sources, "-o", self.binary], check=True)

    def devkit(self, reference, estimate):
        run = subprocess.run([self.binary, reference, estimate], check=True, capture_output=True, text=True)
        return json.loads(run.stdout)

    def odom_eval(self, reference, estimate):
        """The steps of `KittiEvalOdom.eval`, without its plots and files."""
        out = {}
        for alignment in ["none", "scale", "scale_7dof", "7dof", "6dof"]:
            gt = self.tool.load_poses_from_txt(str(HERE / reference))
            est = self.tool.load_poses_from_txt(str(HERE / estimate))
            first = min(est)
            gt_0, est_0 = gt[first], est[first]
            for i in est:
                est[i] = np.linalg.inv(est_0) @ est[i]
                gt[i] = np.linalg.inv(gt_0) @ gt[i]
            if alignment == "scale":
                est = self.tool.scale_optimization(gt, est)
            elif alignment != "none":
                xyz = [np.array([p[i][:3, 3] for i in est]).T for p in (est, gt)]
                r, t, scale = self.umeyama(xyz[0], xyz[1], alignment != "6dof")
                for i in est:
                    est[i][:3, 3] *= scale
                    if alignment != "scale_7dof":
                        est[i] = lie.se3(r, t) @ est[i]
            errors = self.tool.calc_sequence_errors(gt, est)
            t_err, r_err = self.tool.compute_overall_err(errors)
            out[alignment] = {
                "segments": len(errors),
                "t_rel_percent": float(t_err * 100),
                "r_rel_deg_per_100m": float(np.degrees(r_err) * 100),
                "ate_rmse_m": float(self.tool.compute_ATE(gt, est)),
            }
        return out


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kitti-odom-eval", type=pathlib.Path, required=True)
    parser.add_argument("--devkit", type=pathlib.Path, required=True)
    args = parser.parse_args()

    # A drive of about 900 m, its estimate, a monocular one that begins late, one with gaps. (Both at once would
    # meet a defect of kitti-odom-eval, which moves the ground truth only of frames that the result has.)
    truth = drive(320, 2.8, 0.004, 0.02)
    estimate = noisy(truth, 0.02, 0.0008, 1.01)
    write_kitti("drive_gt.txt", truth)
    write_kitti("drive_est.txt", estimate)
    frames = list(range(3, 316))
    mono = noisy(truth, 0.05, 0.0005, 0.4)[frames]
    mono = np.linalg.inv(mono[0]) @ mono
    write_kitti("drive_mono.txt", mono, frames)
    frames = [i for i in range(316) if i not in (150, 151, 152, 233)]
    write_kitti("drive_gaps.txt", noisy(truth, 0.03, 0.0006, 0.97)[frames], frames)
    # Another world frame: nothing starts at the identity.
    moved = lie.se3(Rotation.from_rotvec([0.3, -1.9, 0.8]).as_matrix(), [40.0, -12.0, 5.0])
    write_kitti("drive_moved.txt", moved @ estimate)

    # Hand-held motion at different rates, lengths and clocks.
    t_gt = 1305031100.0 + np.arange(400) / 50.0 + RNG.uniform(-0.002, 0.002, 400)
    hand = drive(400, 0.01, 0.02, 0.04)
    hand[:, :3, 3] += np.cumsum(RNG.normal(0, 0.002, (400, 3)), axis=0)
    write_tum("hand_gt.txt", t_gt, hand)
    pick = np.arange(20, 380, 2)
    other = lie.se3(Rotation.from_rotvec([-0.5, 0.2, 2.8]).as_matrix(), [1.0, 2.0, -3.0])
    hand_est = other @ noisy(hand, 0.001, 0.004, 0.8)[pick]
    write_tum("hand_est.txt", t_gt[pick] + RNG.uniform(-0.006, 0.006, len(pick)), hand_est)
    write_tum("hand_late.txt", t_gt[pick] + 3.25, hand_est)
    dense_t = np.linspace(t_gt[50], t_gt[90], 350)
    dense = hand[np.searchsorted(t_gt, dense_t).clip(0, 399)]
    write_tum("hand_dense.txt", dense_t, other @ dense)

    # Standing still, exactly and with noise; turning on the spot by up to half a turn; a straight line; a plane,
    # and its mirror image.
    still = np.tile(np.eye(4), (60, 1, 1))
    times = np.arange(60) / 10.0
    write_tum("still_gt.txt", times, still)
    jitter = still.copy()
    jitter[:, :3, 3] += RNG.normal(0, 0.01, (60, 3))
    write_tum("still_est.txt", times, jitter)
    spin = still.copy()
    spin[:, :3, :3] = Rotation.from_rotvec(np.outer(np.linspace(0, np.pi, 60), [0.6, 0, 0.8])).as_matrix()
    write_tum("spin_est.txt", times, spin)
    line = still.copy()
    line[:, 0, 3] = np.arange(60) * 0.5
    write_tum("line_gt.txt", times, line)
    write_tum("line_est.txt", times, np.array([moved @ p for p in line]))
    plane = still.copy()
    plane[:, 0, 3], plane[:, 1, 3] = np.cos(times) * times, np.sin(1.3 * times)
    write_tum("plane_gt.txt", times, plane)
    mirror = plane.copy()
    mirror[:, :3, 3] += RNG.normal(0, 0.05, (60, 3))
    mirror[:, 0, 3] *= -1
    write_tum("mirror_est.txt", times, mirror)
    write_tum("one_pose.txt", times[:1], plane[:1])

    with tempfile.TemporaryDirectory() as scratch:
        tools = Tools(args.kitti_odom_eval, args.devkit, pathlib.Path(scratch))
        cases = {
            "drive": kitti_case("drive_gt.txt", "drive_est.txt", 50.0, tools),
            "drive_moved": kitti_case("drive_gt.txt", "drive_moved.txt", 100.0, tools),
            "drive_mono": {
                "format": "kitti",
                "reference": "drive_gt.txt",
                "estimate": "drive_mono.txt",
                "kitti_odom_eval": tools.odom_eval("drive_gt.txt", "drive_mono.txt"),
            },
            "drive_gaps": {
                "format": "kitti",
                "reference": "drive_gt.txt",
                "estimate": "drive_gaps.txt",
                "kitti_odom_eval": tools.odom_eval("drive_gt.txt", "drive_gaps.txt"),
            },
            "hand": tum_case("hand_gt.txt", "hand_est.txt", 0.3),
            "hand_wide": tum_case("hand_gt.txt", "hand_est.txt", 1.0, max_diff=0.1),
            "hand_late": tum_case("hand_gt.txt", "hand_late.txt", 0.3, offset=-3.25),
            "hand_dense": tum_case("hand_gt.txt", "hand_dense.txt", 0.1),
            "still": tum_case("still_gt.txt", "still_est.txt", 0.3),
            "still_reference_only": tum_case("still_gt.txt", "still_gt.txt", 0.3),
            "spin": tum_case("still_gt.txt", "spin_est.txt", 0.3),
            "line": tum_case("line_gt.txt", "line_gt.txt", 2.0),
            "line_moved": tum_case("line_gt.txt", "line_est.txt", 2.0),
            "plane": tum_case("plane_gt.txt", "plane_gt.txt", 1.0),
            "mirror": tum_case("plane_gt.txt", "mirror_est.txt", 1.0),
            "one_pose": tum_case("plane_gt.txt", "one_pose.txt", 1.0),
        }
    golden = {"tools": {"evo": evo_version, "numpy": np.__version__}, "cases": cases}
    (HERE / "golden.json").write_text(json.dumps(golden, indent=1) + "\n")


if __name__ == "__main__":
    main()
