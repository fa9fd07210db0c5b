//! Light on every surface: lamps and windows with shadows, and one bounce between surfaces.

use rayon::prelude::*;

use super::geometry::Geometry;
use super::numeric::{Vec3, along, cross, dot, sin_cos, sub};
use super::room::Layout;

/// Distance between the nodes of a light map in metres.
const NODE_M: f32 = 0.07;
/// Directions in which a node looks for light from other surfaces.
const GATHER: usize = 32;
/// Distance of a node from a wall: thin things that hang there must not swallow it.
const WALL_OFFSET_M: f32 = 0.035;
/// Share of the direct light that further bounces add everywhere.
const FURTHER_BOUNCES: f32 = 0.35;

/// A lamp or window as a few shining points.
#[derive(Debug, Clone)]
pub struct Light {
    /// Where it shines from.
    pub points: Vec<Vec3>,
    /// The side to which it shines; `None`: all around.
    pub normal: Option<Vec3>,
    /// Light sent out, per colour, relative to the other lights of the room.
    pub power: Vec3,
}

/// Incoming light on a grid over one rectangle.
#[derive(Debug, Clone)]
pub struct LightMap {
    columns: usize,
    rows: usize,
    nodes: Vec<Vec3>,
}

impl Light {
    /// A shade of `radius` metres around (x, y) of `place` at height `z`.
    pub fn around(place: Vec3, z: f32, radius: f32, power: Vec3) -> Self {
        let offsets = [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0), (0.0, 0.0)];
        let mut points: Vec<Vec3> =
            offsets.iter().map(|(x, y)| [place[0] + x * radius, place[1] + y * radius, z]).collect();
        points[4][2] = z - radius;
        Self { points, normal: None, power }
    }

    fn onto(&self, geometry: &Geometry, p: Vec3, n: Vec3) -> Vec3 {
        let share = 1.0 / self.points.len() as f32;
        let mut sum = 0.0;
        for &source in &self.points {
            let to = sub(source, p);
            let square = dot(to, to);
            let distance = square.sqrt().max(1e-4);
            let incidence = dot(to, n) / distance;
            let outgoing = self.normal.map_or(0.7, |normal| -dot(to, normal) / distance);
            if incidence > 0.0 && outgoing > 0.0 && !geometry.blocked(p, source) {
                // The constant keeps surfaces beside a lamp from burning out.
                sum += incidence * outgoing / (square + 0.25);
            }
        }
        self.power.map(|power| power * sum * share)
    }
}

impl LightMap {
    /// Incoming light at (u, v), each 0..1.
    pub fn at(&self, u: f32, v: f32) -> Vec3 {
        let x = u.clamp(0.0, 1.0) * (self.columns - 1) as f32;
        let y = v.clamp(0.0, 1.0) * (self.rows - 1) as f32;
        let (i, j) = ((x as usize).min(self.columns - 2), (y as usize).min(self.rows - 2));
        let (fx, fy) = (x - i as f32, y - j as f32);
        let node = |di: usize, dj: usize| self.nodes[(j + dj) * self.columns + i + di];
        let (a, b, c, d) = (node(0, 0), node(1, 0), node(0, 1), node(1, 1));
        [0, 1, 2].map(|k| {
            let (top, bottom) = (a[k] + (b[k] - a[k]) * fx, c[k] + (d[k] - c[k]) * fx);
            top + (bottom - top) * fy
        })
    }
}

/// Light maps of all rectangles, scaled so that the room's mean incoming light is 1.
pub fn light_maps(room: &Layout) -> Vec<LightMap> {
    let geometry = &room.geometry;
    let faces = geometry.rects.len();
    let direct: Vec<LightMap> = (0..faces)
        .into_par_iter()
        .map(|face| {
            grid(geometry, face, |p, n| {
                room.lights.iter().fold([0.0; 3], |sum, l| along(sum, l.onto(geometry, p, n), 1.0))
            })
        })
        .collect();
    let albedo: Vec<Vec3> = (0..faces).map(|face| mean_albedo(room, face)).collect();
    let mean = mean_light(geometry, &direct);
    let directions = hemisphere();
    let full: Vec<LightMap> = (0..faces)
        .into_par_iter()
        .map(|face| {
            let mut bounced = grid(geometry, face, |p, n| {
                let (a, b) = tangents(n);
                let mut sum = [0.0; 3];
                for d in &directions {
                    let direction = along(along([a[0] * d[0], a[1] * d[0], a[2] * d[0]], b, d[1]), n, d[2]);
                    let hit = geometry.trace_all(p, direction);
                    let open = (hit.t * 1.3).min(1.0);
                    let light = direct[hit.face].at(hit.uv[0], hit.uv[1]);
                    for k in 0..3 {
                        sum[k] += albedo[hit.face][k] * light[k] + FURTHER_BOUNCES * mean * open;
                    }
                }
                sum.map(|s| s / GATHER as f32)
            });
            for (node, first) in bounced.nodes.iter_mut().zip(&direct[face].nodes) {
                *node = along(*node, *first, 1.0);
            }
            bounced
        })
        .collect();
    let scale = 1.0 / mean_light(geometry, &full);
    full.into_iter()
        .map(|map| LightMap { nodes: map.nodes.iter().map(|n| n.map(|x| x * scale)).collect(), ..map })
        .collect()
}

fn grid(geometry: &Geometry, face: usize, light: impl Fn(Vec3, Vec3) -> Vec3) -> LightMap {
    let length = geometry.rects[face].length;
    let count = |l: f32| (l / NODE_M).ceil().max(1.0) as usize + 1;
    let (columns, rows) = (count(length[0]), count(length[1]));
    let offset = if geometry.rects[face].group.is_none() { WALL_OFFSET_M } else { 0.004 };
    let normal = geometry.world_normal(face);
    // Nodes at the rim step inside so that they do not lie in the neighbouring wall or box.
    let inset = |i: usize, n: usize, l: f32| {
        let rim = (offset / l).min(0.4);
        (i as f32 / (n - 1) as f32).clamp(rim, 1.0 - rim)
    };
    let mut nodes = Vec::with_capacity(columns * rows);
    for j in 0..rows {
        for i in 0..columns {
            let p = geometry.world_point(face, inset(i, columns, length[0]), inset(j, rows, length[1]));
            nodes.push(light(along(p, normal, offset), normal));
        }
    }
    LightMap { columns, rows, nodes }
}

fn mean_albedo(room: &Layout, face: usize) -> Vec3 {
    let [width, height] = room.geometry.rects[face].length;
    let mut sum = [0.0; 3];
    for j in 0..4 {
        for i in 0..4 {
            let (x, y) = ((i as f32 + 0.5) / 4.0 * width, (j as f32 + 0.5) / 4.0 * height);
            let spot = super::material::Spot { x, y, width, height };
            sum = along(sum, room.finishes[face].at(spot, room.seeds[face]).albedo, 1.0 / 16.0);
        }
    }
    sum
}

/// Mean over the walls, floor and ceiling by area, all colours together.
fn mean_light(geometry: &Geometry, maps: &[LightMap]) -> f32 {
    let (mut sum, mut area) = (0.0, 0.0);
    for (rect, map) in geometry.rects.iter().zip(maps).take(super::geometry::FACES) {
        let a = rect.length[0] * rect.length[1];
        let total: f32 = map.nodes.iter().map(|n| (n[0] + n[1] + n[2]) / 3.0).sum();
        sum += a * total / map.nodes.len() as f32;
        area += a;
    }
    (sum / area).max(1e-6)
}

/// Directions around +z, as many as the cosine law asks for.
fn hemisphere() -> Vec<Vec3> {
    (0..GATHER)
        .map(|i| {
            let square = (i as f32 + 0.5) / GATHER as f32;
            // The golden angle spreads them evenly.
            let (sin, cos) = sin_cos(f64::from(i as u32) * 2.399_963_229_728_653);
            let r = square.sqrt();
            [r * cos as f32, r * sin as f32, (1.0 - square).sqrt()]
        })
        .collect()
}

fn tangents(n: Vec3) -> (Vec3, Vec3) {
    let helper = if n[2].abs() < 0.7 { [0.0, 0.0, 1.0] } else { [1.0, 0.0, 0.0] };
    let a = cross(helper, n);
    let length = dot(a, a).sqrt();
    let a = a.map(|x| x / length);
    (a, cross(n, a))
}
