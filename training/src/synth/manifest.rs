//! `scene.json`: what a recording was made from.

use super::scene::Scene;
use super::sensor::SensorOptions;
use super::volume::VolumeKind;
use super::writer::{ImageFormat, Recipe, Shutter};
use super::{GENERATOR_VERSION, output};

/// Value of `generator`, by which a folder is known as ours.
pub const GENERATOR: &str = "grnet-train synth";

/// Contents of `scene.json`.
#[derive(Debug, serde::Serialize)]
pub struct Manifest {
    generator: &'static str,
    generator_version: u32,
    room: u64,
    room_size_m: [f32; 3],
    texel_m: f32,
    seed: u64,
    volume: VolumeKind,
    frames_per_sequence: u32,
    rate_hz: f64,
    frames_of_reference: &'static str,
    camera: Intrinsics,
    image_format: ImageFormat,
    edge_samples: usize,
    sensor: SensorOptions,
    shutter: Shutter,
    sequences: Vec<Sequence>,
    pictures: Vec<Corners>,
}

#[derive(Debug, serde::Serialize)]
struct Intrinsics {
    width_px: u32,
    height_px: u32,
    fx_px: f64,
    fy_px: f64,
    cx_px: f64,
    cy_px: f64,
}

#[derive(Debug, serde::Serialize)]
struct Sequence {
    folder: String,
    split: &'static str,
}

#[derive(Debug, serde::Serialize)]
struct Corners {
    face: usize,
    corners_in_world_m: Vec<[f64; 3]>,
}

impl Manifest {
    /// The manifest of a recording of `scene`.
    pub fn new(recipe: &Recipe, scene: &Scene) -> Self {
        let camera = recipe.camera;
        let ((width_px, height_px), (fx_px, fy_px), (cx_px, cy_px)) =
            (camera.size_px(), camera.focal_px(), camera.centre_px());
        let sequences = (0..recipe.sequences)
            .map(|s| Sequence { folder: output::sequence_name(s), split: recipe.split_of(s) })
            .collect();
        let pictures = scene
            .landmarks()
            .chunks(4)
            .map(|c| Corners {
                face: c[0].face,
                corners_in_world_m: c.iter().map(|l| l.point_in_world).collect(),
            })
            .collect();
        Self {
            generator: GENERATOR,
            generator_version: GENERATOR_VERSION,
            room: recipe.scene.room,
            room_size_m: scene.size_m(),
            texel_m: recipe.scene.texel_m,
            seed: recipe.seed,
            volume: recipe.volume,
            frames_per_sequence: recipe.frames,
            rate_hz: recipe.rate_hz,
            frames_of_reference: "pose.txt: world_from_camera, metres; camera x right, y down, z forward; world z up, \
                                  origin on the floor in the middle of the room; pixel centres at integers",
            camera: Intrinsics { width_px, height_px, fx_px, fy_px, cx_px, cy_px },
            image_format: recipe.format,
            edge_samples: recipe.edge_samples,
            sensor: recipe.sensor,
            shutter: recipe.shutter,
            sequences,
            pictures,
        }
    }
}
