//! A finished room: shapes with baked, lit textures.

use rayon::prelude::*;

use super::geometry::{FACES, Geometry};
use super::light::light_maps;
use super::material::{Finish, Spot};
use super::numeric::Vec3;
use super::room::furnish;
use super::texture::Texture;

/// Which room to build, and how finely.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SceneOptions {
    /// Number of the room: each is another place.
    pub room: u64,
    /// Size of a texel on walls and furniture in metres; pictures and screens are a third finer. 4 mm suits
    /// 640x480, 10 mm suits images of about 100 px and is built three times sooner.
    pub texel_m: f32,
}

impl Default for SceneOptions {
    fn default() -> Self {
        Self { room: 1, texel_m: 0.004 }
    }
}

/// A corner of a picture on a wall.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Landmark {
    /// Metres, in the world.
    pub point_in_world: [f64; 3],
    /// The picture's face, as in [`RenderTarget::face`](super::RenderTarget::face); four corners share one.
    pub face: usize,
}

/// A room that can be rendered from any pose inside it.
#[derive(Debug)]
pub struct Scene {
    geometry: Geometry,
    textures: Vec<Texture>,
    landmarks: Vec<Landmark>,
    options: SceneOptions,
}

impl Scene {
    /// Furnishes, lights and bakes a room: 4 s of one core at the default texel size, about 1.5 s at 10 mm.
    ///
    /// The same options give the same room, bit by bit, whatever the number of threads.
    pub fn build(options: SceneOptions) -> Self {
        let room = furnish(options.room);
        let maps = light_maps(&room);
        let textures = (0..room.geometry.rects.len())
            .into_par_iter()
            .map(|face| {
                let [width, height] = room.geometry.rects[face].length;
                let (finish, seed, map) = (room.finishes[face], room.seeds[face], &maps[face]);
                let texel_m = options.texel_m * coarseness(&finish, face);
                // Multiples of 8 keep the first halvings of the mip pyramid exact.
                let texels = |length: f32| (length / texel_m / 8.0).ceil().max(1.0) as usize * 8;
                Texture::bake(texels(width), texels(height), finish.subsamples(), |u, v| {
                    let surface = finish.at(Spot { x: u * width, y: v * height, width, height }, seed);
                    let light = map.at(u, v);
                    [0, 1, 2].map(|k| surface.albedo[k] * light[k] + surface.emission[k])
                })
            })
            .collect();
        let landmarks = room.landmarks.iter();
        let landmarks =
            landmarks.map(|(p, face)| Landmark { point_in_world: p.map(f64::from), face: *face }).collect();
        Self { geometry: room.geometry, textures, landmarks, options }
    }

    /// What it was built from.
    pub fn options(&self) -> SceneOptions {
        self.options
    }

    /// Extent in x, y and z in metres: the origin lies on the floor in the middle, z points up.
    pub fn size_m(&self) -> [f32; 3] {
        self.geometry.size
    }

    /// The corners of all pictures.
    pub fn landmarks(&self) -> &[Landmark] {
        &self.landmarks
    }

    /// The shapes, for clearance and visibility.
    pub fn geometry(&self) -> &Geometry {
        &self.geometry
    }

    /// What a face belongs to: `wall`, `floor`, `ceiling`, `picture`, `desk`...
    pub fn face_name(&self, face: usize) -> &'static str {
        match (face, self.geometry.rects.get(face).and_then(|r| r.group)) {
            (_, Some(group)) => self.geometry.groups[group].name,
            (4, None) => "floor",
            (5, None) => "ceiling",
            _ => "wall",
        }
    }

    pub(super) fn texture(&self, face: usize) -> &Texture {
        &self.textures[face]
    }

    /// Point (u, v) of a face in the world, in metres.
    pub fn world_point(&self, face: usize, u: f32, v: f32) -> Vec3 {
        self.geometry.world_point(face, u, v)
    }
}

fn coarseness(finish: &Finish, face: usize) -> f32 {
    match finish {
        Finish::Framed(_) | Finish::Screen | Finish::Books | Finish::DeskTop { .. } => 0.67,
        Finish::Ceiling => 1.5,
        // The underside of furniture is seldom seen.
        _ if face >= FACES && (face - FACES) % FACES == 4 => 3.0,
        _ => 1.0,
    }
}
