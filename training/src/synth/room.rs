//! Furnishes a room from its seed: sizes, finishes, furniture along the walls, pictures, windows and lamps.

use rand::seq::SliceRandom;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::furniture::{self, Part, muted, paint, part, timber, vivid};
use super::geometry::{Cuboid, FACES, Geometry};
use super::light::Light;
use super::material::Finish;
use super::numeric::{Vec3, sin_cos};
use super::picture::PICTURES;

/// A room before it is lit and baked.
#[derive(Debug, Clone)]
pub struct Layout {
    /// All shapes.
    pub geometry: Geometry,
    /// Finish of every rectangle of `geometry`.
    pub finishes: Vec<Finish>,
    /// Seed of every rectangle's pattern.
    pub seeds: Vec<u32>,
    /// Lamps and windows.
    pub lights: Vec<Light>,
    /// Corners of the pictures, and the rectangle that each belongs to.
    pub landmarks: Vec<(Vec3, usize)>,
}

/// What stands at a stretch of wall.
#[derive(Debug, Clone, Copy)]
enum Bay {
    Desk,
    Bookshelf,
    Cabinet,
    Sideboard,
    Sofa,
    Door,
    Window,
    Lamp,
    Plant,
    Cartons,
}

/// A wall's frame: where it stands and which way it runs (x right as one faces it, y into it).
#[derive(Debug, Clone, Copy)]
struct Wall {
    middle: [f32; 2],
    turn: [f32; 2],
    length: f32,
}

/// The room number `seed`; the same seed gives the same room for ever within one generator version.
pub fn furnish(seed: u64) -> Layout {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let size = [rng.random_range(4.8..6.0), rng.random_range(4.4..5.4), rng.random_range(2.5..2.8)];
    let mut room = Layout {
        geometry: Geometry::new(size),
        finishes: Vec::new(),
        seeds: (0..FACES).map(|_| rng.random()).collect(),
        lights: Vec::new(),
        landmarks: Vec::new(),
    };
    room.finishes = room_finishes(&mut rng);
    let mut walls = [
        Wall { middle: [size[0] / 2.0, 0.0], turn: [0.0, -1.0], length: size[1] },
        Wall { middle: [0.0, size[1] / 2.0], turn: [1.0, 0.0], length: size[0] },
        Wall { middle: [-size[0] / 2.0, 0.0], turn: [0.0, 1.0], length: size[1] },
        Wall { middle: [0.0, -size[1] / 2.0], turn: [-1.0, 0.0], length: size[0] },
    ];
    walls.shuffle(&mut rng);
    let mut deck = vec![
        Bay::Bookshelf,
        Bay::Desk,
        Bay::Cabinet,
        Bay::Sideboard,
        Bay::Plant,
        Bay::Cartons,
        Bay::Desk,
        Bay::Bookshelf,
        Bay::Cabinet,
        Bay::Lamp,
        Bay::Sideboard,
        Bay::Bookshelf,
        Bay::Cartons,
        Bay::Plant,
    ];
    deck.shuffle(&mut rng);
    let first = [Bay::Window, Bay::Sofa, Bay::Window, Bay::Door];
    let mut chairs = Vec::new();
    for (wall, first) in walls.into_iter().zip(first) {
        room.line_wall(&mut rng, wall, first, &mut deck, &mut chairs);
    }
    room.middle(&mut rng);
    for (place, yaw_rad) in chairs {
        let free = |z| room.geometry.clearance_m([place[0], place[1], z]) > 0.27;
        if free(0.45) && free(0.8) {
            let parts = furniture::chair(&mut rng);
            room.add(&mut rng, "chair", [place[0], place[1], 0.0], turn_of(yaw_rad), &parts);
        }
    }
    room
}

fn room_finishes(rng: &mut ChaCha8Rng) -> Vec<Finish> {
    let mut walls = vec![
        Finish::Plaster { colour: muted(rng), skirting: true },
        Finish::Wallpaper { colour: muted(rng), accent: muted(rng), pattern: rng.random() },
        Finish::Wallpaper { colour: muted(rng), accent: paint(rng), pattern: rng.random() },
        Finish::Plaster { colour: paint(rng), skirting: true },
        Finish::Brick { colour: [0.4, 0.17, 0.1] },
    ];
    walls.shuffle(rng);
    walls.truncate(4);
    let floor = if rng.random_bool(0.6) {
        Finish::Planks { colour: timber(rng) }
    } else {
        Finish::Tiles { colour: muted(rng), accent: paint(rng) }
    };
    walls.extend([floor, Finish::Ceiling]);
    walls
}

impl Layout {
    /// Adds a group; its y axis points into the wall when `turn` is the wall's.
    fn add(
        &mut self,
        rng: &mut ChaCha8Rng,
        name: &'static str,
        origin: Vec3,
        turn: [f32; 2],
        parts: &[Part],
    ) -> usize {
        let boxes: Vec<Cuboid> = parts.iter().map(|p| p.shape).collect();
        let first = self.geometry.rects.len();
        self.geometry.add(name, origin, turn, &boxes);
        for part in parts {
            self.finishes.extend(part.finishes);
            self.seeds.extend((0..FACES).map(|_| rng.random::<u32>()));
        }
        first
    }

    fn line_wall(
        &mut self,
        rng: &mut ChaCha8Rng,
        wall: Wall,
        first: Bay,
        deck: &mut Vec<Bay>,
        chairs: &mut Vec<([f32; 2], f32)>,
    ) {
        // The walls across y leave the corners to the furniture of the walls across x.
        let margin = if wall.turn[0] == 0.0 { 0.06 } else { 0.95 };
        let mut free = wall.length - 2.0 * margin;
        let mut bays = vec![(first, width(first, rng))];
        free -= bays[0].1;
        let mut index = 0;
        while index < deck.len() {
            let wide = width(deck[index], rng);
            if wide + 0.04 <= free {
                bays.push((deck.remove(index), wide));
                free -= wide;
            } else {
                index += 1;
            }
        }
        bays.shuffle(rng);
        let gap = free / bays.len() as f32;
        let mut s = -wall.length / 2.0 + margin;
        for (bay, wide) in bays {
            s += gap / 2.0;
            self.fill(rng, wall, bay, s + wide / 2.0, wide, chairs);
            s += wide + gap / 2.0;
        }
    }

    fn fill(
        &mut self,
        rng: &mut ChaCha8Rng,
        wall: Wall,
        bay: Bay,
        s: f32,
        wide: f32,
        chairs: &mut Vec<([f32; 2], f32)>,
    ) {
        let origin = wall.point(s, 0.0);
        let low = rng.random_bool(0.4);
        let (name, parts) = match bay {
            Bay::Desk => {
                let place = wall.point(s + rng.random_range(-0.15..0.15), -1.05);
                chairs.push(([place[0], place[1]], wall.yaw_rad() + rng.random_range(-0.5..0.5)));
                ("desk", furniture::desk(rng, wide))
            }
            Bay::Bookshelf => ("bookshelf", furniture::bookshelf(rng, wide, if low { 1.15 } else { 1.9 })),
            Bay::Cabinet => ("cabinet", furniture::cabinet(rng, wide, if low { 0.95 } else { 1.5 })),
            Bay::Sideboard => ("sideboard", furniture::sideboard(rng, wide)),
            Bay::Sofa => ("sofa", furniture::sofa(rng, wide)),
            Bay::Plant => ("plant", furniture::plant(rng)),
            Bay::Cartons => ("cartons", furniture::cartons(rng)),
            Bay::Lamp => {
                let light = [2.6, 2.1, 1.5];
                self.lights.push(Light::around(wall.point(s, -0.3), 1.6, 0.21, [0.75, 0.6, 0.42]));
                ("floor lamp", furniture::floor_lamp(light))
            }
            Bay::Door => {
                let door = Finish::Door { colour: timber(rng) };
                ("door", vec![part([-wide / 2.0, wide / 2.0], [-0.035, -0.002], [0.0, 2.05], door)])
            }
            Bay::Window => return self.window(rng, wall, s, wide),
        };
        let top = parts.iter().map(|p| p.shape.max[2]).fold(0.0, f32::max);
        self.add(rng, name, origin, wall.turn, &parts);
        if !matches!(bay, Bay::Door) {
            self.pictures(rng, wall, s, wide, top);
        }
    }

    fn window(&mut self, rng: &mut ChaCha8Rng, wall: Wall, s: f32, wide: f32) {
        let half = wide / 2.0 - 0.05;
        let white = Finish::Lacquer { colour: [0.75, 0.74, 0.7] };
        let parts = [
            part([-half, half], [-0.05, -0.005], [0.95, 2.15], white).front(Finish::Window),
            part([-half - 0.04, half + 0.04], [-0.22, -0.002], [0.9, 0.945], white),
            part([-half + 0.1, half - 0.1], [-0.15, -0.05], [0.14, 0.74], white).front(Finish::Radiator),
        ];
        self.add(rng, "window", wall.point(s, 0.0), wall.turn, &parts);
        let points = [-0.6f32, 0.0, 0.6].iter().flat_map(|a| [1.25, 1.85].map(|z| (half * a, z)));
        let points = points.map(|(dx, z)| {
            let p = wall.point(s + dx, -0.08);
            [p[0], p[1], z]
        });
        let normal = [wall.turn[1], -wall.turn[0], 0.0];
        self.lights.push(Light { points: points.collect(), normal: Some(normal), power: [1.5, 1.75, 2.1] });
        // A pot on the sill.
        let x = rng.random_range(-half..half - 0.14);
        let pot = part([x, x + 0.13], [-0.2, -0.07], [0.945, 1.08], Finish::Lacquer { colour: vivid(rng) });
        self.add(rng, "pot", wall.point(s, 0.0), wall.turn, &[pot]);
    }

    fn pictures(&mut self, rng: &mut ChaCha8Rng, wall: Wall, s: f32, wide: f32, below: f32) {
        let (bottom, top) = ((below + 0.1).max(1.05), self.geometry.size[2] - 0.25);
        let count = if wide > 1.15 { 2 } else { 1 };
        for k in 0..count {
            let room = wide / count as f32;
            let w = (room - 0.06).min(rng.random_range(0.42..0.85));
            let h = (top - bottom).min(w * rng.random_range(0.75..1.45));
            if h < 0.3 {
                continue;
            }
            let slack = (room - w) / 2.0 - 0.02;
            let x = -wide / 2.0 + room * (k as f32 + 0.5) + slack * rng.random_range(-1.0..1.0);
            let z = bottom + (top - bottom - h) * rng.random_range(0.1..0.7);
            let kind = PICTURES[(self.landmarks.len() / 4 + rng.random_range(0..2)) % PICTURES.len()];
            let frame = Finish::Wood { colour: timber(rng) };
            let picture = part([x - w / 2.0, x + w / 2.0], [-0.028, -0.002], [z, z + h], frame)
                .front(Finish::Framed(kind));
            let first = self.add(rng, "picture", wall.point(s, 0.0), wall.turn, &[picture]);
            let face = first + 2;
            for (u, v) in [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)] {
                self.landmarks.push((self.geometry.world_point(face, u, v), face));
            }
        }
    }

    /// Rug, low table, hanging lamp and ceiling lights.
    fn middle(&mut self, rng: &mut ChaCha8Rng) {
        let [w, d, h] = self.geometry.size;
        let place = [rng.random_range(-0.5..0.5), rng.random_range(-0.4..0.4), 0.0];
        let yaw = rng.random_range(-0.4..0.4);
        let rug = Finish::Rug { colour: muted(rng), accent: vivid(rng) };
        let rug = part([-1.0, 1.0], [-0.7, 0.7], [0.001, 0.012], rug);
        self.add(rng, "rug", place, turn_of(yaw), &[rug]);
        let table = furniture::coffee_table(rng);
        let turn = turn_of(yaw + rng.random_range(-0.3..0.3));
        self.add(rng, "coffee table", [place[0], place[1], 0.012], turn, &table);
        let shade = [
            part([-0.2, 0.2], [-0.2, 0.2], [h - 0.5, h - 0.3], Finish::Lamp { light: [2.2, 1.9, 1.5] }),
            part([-0.008, 0.008], [-0.008, 0.008], [h - 0.3, h], Finish::Lacquer { colour: [0.05; 3] }),
        ];
        let hook = [place[0] * 0.5, place[1] * 0.5, 0.0];
        let turn = turn_of(rng.random_range(0.0..1.5));
        self.add(rng, "hanging lamp", hook, turn, &shade);
        self.lights.push(Light::around(hook, h - 0.4, 0.31, [0.9, 0.75, 0.55]));
        for side in [-1.0f32, 1.0] {
            let centre = [side * w * 0.3, d * rng.random_range(-0.25..0.25), 0.0];
            let panel = part(
                [-0.3, 0.3],
                [-0.3, 0.3],
                [h - 0.04, h - 0.001],
                Finish::Lamp { light: [3.0, 2.95, 2.8] },
            );
            self.add(rng, "ceiling light", centre, [1.0, 0.0], &[panel]);
            let points = [(-0.2, -0.2), (0.2, -0.2), (-0.2, 0.2), (0.2, 0.2)];
            let points = points.map(|(x, y)| [centre[0] + x, centre[1] + y, h - 0.06]).to_vec();
            let power = 1.4 * rng.random_range(0.7..1.2);
            self.lights.push(Light {
                points,
                normal: Some([0.0, 0.0, -1.0]),
                power: [power, power * 0.97, power * 0.9],
            });
        }
    }
}

impl Wall {
    /// The world point `s` metres to the right of the wall's middle and `y` into it, on the floor.
    fn point(&self, s: f32, y: f32) -> Vec3 {
        let [c, n] = self.turn;
        [self.middle[0] + c * s - n * y, self.middle[1] + n * s + c * y, 0.0]
    }

    fn yaw_rad(&self) -> f32 {
        match (self.turn[0] as i32, self.turn[1] as i32) {
            (1, _) => 0.0,
            (-1, _) => std::f32::consts::PI,
            (_, s) => s as f32 * std::f32::consts::FRAC_PI_2,
        }
    }
}

fn turn_of(yaw_rad: f32) -> [f32; 2] {
    let (sin, cos) = sin_cos(f64::from(yaw_rad));
    [cos as f32, sin as f32]
}

fn width(bay: Bay, rng: &mut ChaCha8Rng) -> f32 {
    match bay {
        Bay::Desk => rng.random_range(1.3..1.6),
        Bay::Bookshelf | Bay::Cabinet => rng.random_range(0.8..1.15),
        Bay::Sideboard => rng.random_range(1.15..1.5),
        Bay::Sofa => rng.random_range(1.6..1.9),
        Bay::Door => 0.95,
        Bay::Window => rng.random_range(1.3..1.7),
        Bay::Lamp => 0.5,
        Bay::Plant => 0.65,
        Bay::Cartons => 0.75,
    }
}
