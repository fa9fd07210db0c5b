//! Pieces of furniture as boxes in a wall's frame: x to the right as one faces the wall, y into the wall
//! (so furniture stands at y < 0 and its front looks to -y), z up.

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::geometry::{Cuboid, FACES};
use super::material::Finish;
use super::numeric::{Vec3, hsv};

/// A box with a finish for each face.
#[derive(Debug, Clone)]
pub struct Part {
    /// Its extent in the piece's frame.
    pub shape: Cuboid,
    /// Finishes of -x, +x, -y, +y, -z, +z.
    pub finishes: [Finish; FACES],
}

/// A box of one finish: centre in x, nearest and farthest y, bottom and top.
pub fn part(x: [f32; 2], y: [f32; 2], z: [f32; 2], finish: Finish) -> Part {
    Part { shape: Cuboid { min: [x[0], y[0], z[0]], max: [x[1], y[1], z[1]] }, finishes: [finish; FACES] }
}

impl Part {
    /// Another finish for the front (-y).
    #[must_use]
    pub fn front(mut self, finish: Finish) -> Self {
        self.finishes[2] = finish;
        self
    }

    /// Another finish for the top (+z).
    #[must_use]
    pub fn top(mut self, finish: Finish) -> Self {
        self.finishes[5] = finish;
        self
    }
}

/// A saturated colour at random.
pub fn vivid(rng: &mut ChaCha8Rng) -> Vec3 {
    hsv(rng.random(), rng.random_range(0.35..0.75), rng.random_range(0.4..0.85))
}

/// A muted wall or cloth colour at random.
pub fn muted(rng: &mut ChaCha8Rng) -> Vec3 {
    hsv(rng.random(), rng.random_range(0.1..0.38), rng.random_range(0.7..0.92))
}

/// A wall paint at random: of a clear hue, but not glaring.
pub fn paint(rng: &mut ChaCha8Rng) -> Vec3 {
    hsv(rng.random(), rng.random_range(0.3..0.5), rng.random_range(0.6..0.8))
}

/// A wood colour at random, from walnut to beech.
pub fn timber(rng: &mut ChaCha8Rng) -> Vec3 {
    hsv(rng.random_range(0.055..0.105), rng.random_range(0.35..0.7), rng.random_range(0.42..0.82))
}

/// A table with drawers, a screen, a keyboard and odds and ends; `w` metres wide.
pub fn desk(rng: &mut ChaCha8Rng, w: f32) -> Vec<Part> {
    let wood = Finish::Wood { colour: timber(rng) };
    let (h, back, front) = (0.74, -0.03, -0.73);
    let mut parts = vec![
        part([-w / 2.0, w / 2.0], [front, back], [h - 0.03, h], wood)
            .top(Finish::DeskTop { colour: timber(rng) }),
    ];
    for x in [-w / 2.0 + 0.02, w / 2.0 - 0.07] {
        for y in [front + 0.02, back - 0.07] {
            parts.push(part([x, x + 0.05], [y, y + 0.05], [0.0, h - 0.03], wood));
        }
    }
    let side = if rng.random() { 1.0 } else { -1.0 };
    let x = side * (w / 2.0 - 0.32);
    let lacquer = Finish::Lacquer { colour: vivid(rng) };
    parts.push(
        part([x - 0.2, x + 0.2], [front + 0.05, back - 0.1], [0.02, 0.6], lacquer)
            .front(Finish::Drawers { colour: vivid(rng), drawers: 3 }),
    );
    let m = -side * rng.random_range(0.0..0.25);
    let plastic = Finish::Lacquer { colour: [0.04; 3] };
    parts.push(part([m - 0.03, m + 0.03], [-0.27, -0.23], [h, h + 0.15], plastic));
    parts.push(part([m - 0.12, m + 0.12], [-0.33, -0.17], [h, h + 0.015], plastic));
    parts.push(
        part([m - 0.28, m + 0.28], [-0.29, -0.26], [h + 0.11, h + 0.46], plastic).front(Finish::Screen),
    );
    parts.push(part([m - 0.22, m + 0.22], [-0.6, -0.46], [h, h + 0.025], plastic).top(Finish::Keyboard));
    let x = side * (w / 2.0 - 0.2);
    let z = h + rng.random_range(0.12..0.3);
    parts.push(part([x - 0.13, x + 0.13], [-0.35, -0.12], [h, z], Finish::Carton));
    let mug = -side * (w / 2.0 - 0.12);
    parts.push(part(
        [mug - 0.04, mug + 0.04],
        [-0.5, -0.42],
        [h, h + 0.1],
        Finish::Lacquer { colour: vivid(rng) },
    ));
    parts
}

/// A chair whose seat centre is the origin, its back towards -y.
pub fn chair(rng: &mut ChaCha8Rng) -> Vec<Part> {
    let wood = Finish::Wood { colour: timber(rng) };
    let cloth = Finish::Cloth { colour: vivid(rng), accent: vivid(rng) };
    let mut parts = vec![
        part([-0.22, 0.22], [-0.22, 0.22], [0.42, 0.47], wood).top(cloth),
        part([-0.21, 0.21], [-0.22, -0.18], [0.62, 0.92], cloth),
    ];
    for x in [-0.21, 0.17] {
        parts.push(part([x, x + 0.04], [0.17, 0.21], [0.0, 0.42], wood));
        parts.push(part([x, x + 0.04], [-0.22, -0.18], [0.0, 0.62], wood));
    }
    parts
}

/// Open shelves full of books and boxes.
pub fn bookshelf(rng: &mut ChaCha8Rng, w: f32, h: f32) -> Vec<Part> {
    let wood = Finish::Wood { colour: timber(rng) };
    let (front, back) = (-0.34, -0.01);
    let mut parts = vec![
        part([-w / 2.0, -w / 2.0 + 0.025], [front, back], [0.0, h], wood),
        part([w / 2.0 - 0.025, w / 2.0], [front, back], [0.0, h], wood),
        part([-w / 2.0, w / 2.0], [back - 0.015, back], [0.0, h], wood),
    ];
    let shelves = ((h - 0.08) / 0.36) as usize;
    let pitch = (h - 0.08) / shelves as f32;
    for k in 0..=shelves {
        let z = 0.05 + k as f32 * pitch;
        parts.push(part([-w / 2.0 + 0.025, w / 2.0 - 0.025], [front, back - 0.015], [z - 0.025, z], wood));
        if k == shelves {
            break;
        }
        let mut x = -w / 2.0 + 0.03;
        while x < w / 2.0 - 0.1 {
            let end = (x + rng.random_range(0.15..0.6)).min(w / 2.0 - 0.03);
            let depth = rng.random_range(0.16..0.27);
            if rng.random_bool(0.75) {
                let books = part(
                    [x, end],
                    [back - 0.02 - depth, back - 0.02],
                    [z, z + rng.random_range(0.22..0.3)],
                    Finish::Lacquer { colour: [0.5, 0.47, 0.4] },
                );
                parts.push(books.front(Finish::Books));
            } else if rng.random_bool(0.6) {
                let end = end.min(x + 0.3);
                parts.push(part(
                    [x, end],
                    [back - 0.02 - depth, back - 0.03],
                    [z, z + rng.random_range(0.1..0.24)],
                    Finish::Lacquer { colour: vivid(rng) },
                ));
            }
            x = end + rng.random_range(0.005..0.06);
        }
    }
    parts
}

/// A closed cabinet with things on top.
pub fn cabinet(rng: &mut ChaCha8Rng, w: f32, h: f32) -> Vec<Part> {
    let colour = if rng.random() { timber(rng) } else { muted(rng) };
    let doors = if w > 0.9 { 3 } else { 2 };
    let mut parts = vec![
        part([-w / 2.0, w / 2.0], [-0.48, -0.01], [0.04, h], Finish::Wood { colour })
            .front(Finish::Doors { colour, doors }),
        part(
            [-w / 2.0 + 0.03, w / 2.0 - 0.03],
            [-0.44, -0.04],
            [0.0, 0.04],
            Finish::Lacquer { colour: [0.05; 3] },
        ),
    ];
    clutter(rng, &mut parts, w, h, 0.4);
    parts
}

/// A chest of drawers with a television or clutter on top.
pub fn sideboard(rng: &mut ChaCha8Rng, w: f32) -> Vec<Part> {
    let colour = if rng.random() { timber(rng) } else { vivid(rng) };
    let half = w / 2.0;
    let mut parts = Vec::new();
    for x in [[-half, -0.005], [0.005, half]] {
        parts.push(
            part(x, [-0.45, -0.02], [0.12, 0.78], Finish::Wood { colour })
                .front(Finish::Drawers { colour, drawers: 3 }),
        );
    }
    for x in [-half + 0.02, half - 0.07] {
        parts.push(part([x, x + 0.05], [-0.43, -0.38], [0.0, 0.12], Finish::Wood { colour }));
        parts.push(part([x, x + 0.05], [-0.1, -0.05], [0.0, 0.12], Finish::Wood { colour }));
    }
    if rng.random() && w > 1.1 {
        let plastic = Finish::Lacquer { colour: [0.03; 3] };
        parts.push(part([-0.15, 0.15], [-0.32, -0.12], [0.78, 0.81], plastic));
        parts.push(part([-0.48, 0.48], [-0.24, -0.19], [0.81, 1.38], plastic).front(Finish::Screen));
    } else {
        clutter(rng, &mut parts, w, 0.78, 0.35);
    }
    parts
}

/// A sofa with arms, back and cushions.
pub fn sofa(rng: &mut ChaCha8Rng, w: f32) -> Vec<Part> {
    let cloth = Finish::Cloth { colour: vivid(rng), accent: muted(rng) };
    let half = w / 2.0;
    let mut parts = vec![
        part([-half, half], [-0.85, -0.03], [0.05, 0.28], cloth),
        part([-half, half], [-0.25, -0.03], [0.28, 0.82], cloth),
        part([-half, -half + 0.17], [-0.85, -0.25], [0.28, 0.6], cloth),
        part([half - 0.17, half], [-0.85, -0.25], [0.28, 0.6], cloth),
    ];
    let seats = 2;
    let seat = (w - 0.36) / seats as f32;
    for k in 0..seats {
        let x = -half + 0.18 + seat * k as f32;
        parts.push(part([x + 0.005, x + seat - 0.005], [-0.87, -0.25], [0.28, 0.44], cloth));
        let c = x + seat * rng.random_range(0.35..0.65);
        let cushion = Finish::Cloth { colour: vivid(rng), accent: vivid(rng) };
        parts.push(part([c - 0.21, c + 0.21], [-0.4, -0.26], [0.44, 0.8], cushion));
    }
    parts
}

/// A low table, centred on the origin, with papers, books and a bowl.
pub fn coffee_table(rng: &mut ChaCha8Rng) -> Vec<Part> {
    let colour = timber(rng);
    let wood = Finish::Wood { colour };
    let mut parts = vec![part([-0.5, 0.5], [-0.3, 0.3], [0.39, 0.43], wood).top(Finish::DeskTop { colour })];
    for (x, y) in [(-0.48, -0.28), (0.42, -0.28), (-0.48, 0.22), (0.42, 0.22)] {
        parts.push(part([x, x + 0.06], [y, y + 0.06], [0.0, 0.39], wood));
    }
    parts.push(part([-0.48, 0.48], [-0.26, 0.26], [0.14, 0.16], wood));
    parts.push(
        part([0.1, 0.34], [-0.2, -0.03], [0.43, 0.49], Finish::Lacquer { colour: vivid(rng) })
            .front(Finish::Books),
    );
    parts.push(part([-0.35, -0.2], [0.02, 0.17], [0.43, 0.52], Finish::Lacquer { colour: vivid(rng) }));
    parts
}

/// A pile of boxes on the floor.
pub fn cartons(rng: &mut ChaCha8Rng) -> Vec<Part> {
    let mut parts = Vec::new();
    let mut z = 0.0;
    for _ in 0..rng.random_range(2..4) {
        let (w, d, h) =
            (rng.random_range(0.2..0.3), rng.random_range(0.17..0.24), rng.random_range(0.2..0.42));
        let shift = rng.random_range(-0.06..0.06);
        let finish =
            if rng.random_bool(0.6) { Finish::Carton } else { Finish::Lacquer { colour: vivid(rng) } };
        parts.push(part([shift - w, shift + w], [-0.35 - d, -0.35 + d], [z, z + h], finish));
        z += h;
    }
    parts
}

/// A standing lamp; its shade's lower and upper rim are at 1.45 m and 1.75 m.
pub fn floor_lamp(light: Vec3) -> Vec<Part> {
    let metal = Finish::Lacquer { colour: [0.12; 3] };
    vec![
        part([-0.14, 0.14], [-0.44, -0.16], [0.0, 0.03], metal),
        part([-0.015, 0.015], [-0.315, -0.285], [0.03, 1.45], metal),
        part([-0.17, 0.17], [-0.47, -0.13], [1.45, 1.75], Finish::Lamp { light }),
    ]
}

/// A plant: a pot and a crown of leafy boxes.
pub fn plant(rng: &mut ChaCha8Rng) -> Vec<Part> {
    let mut parts =
        vec![part([-0.15, 0.15], [-0.45, -0.15], [0.0, 0.32], Finish::Lacquer { colour: vivid(rng) })];
    for _ in 0..9 {
        let (x, y, z) =
            (rng.random_range(-0.2..0.2), rng.random_range(-0.5..-0.15), rng.random_range(0.36..1.15));
        let (w, h) = (rng.random_range(0.05..0.14), rng.random_range(0.04..0.14));
        let green = hsv(rng.random_range(0.22..0.38), 0.6, rng.random_range(0.3..0.75));
        let leaf = Finish::Cloth { colour: green, accent: hsv(0.3, 0.7, 0.3) };
        parts.push(part([x - w, x + w], [y - 0.05, y + 0.05], [z, z + h], leaf));
    }
    parts.push(part(
        [-0.015, 0.015],
        [-0.32, -0.29],
        [0.32, 1.2],
        Finish::Wood { colour: [0.2, 0.14, 0.08] },
    ));
    parts
}

fn clutter(rng: &mut ChaCha8Rng, parts: &mut Vec<Part>, w: f32, z: f32, depth: f32) {
    let mut x = -w / 2.0 + 0.04;
    while x < w / 2.0 - 0.15 {
        let end = (x + rng.random_range(0.1..0.4)).min(w / 2.0 - 0.03);
        let (near, h) = (-depth + rng.random_range(0.0..0.12), rng.random_range(0.07..0.3));
        let shell = Finish::Lacquer { colour: vivid(rng) };
        let thing = match rng.random_range(0..4) {
            0 => part([x, end], [near, -0.06], [z, z + h], Finish::Carton),
            1 => part([x, end], [near, -0.08], [z, z + h.max(0.2)], shell).front(Finish::Books),
            2 => part([x, end.min(x + 0.14)], [near, near + 0.12], [z, z + h], shell),
            _ => part([x, end], [near, -0.05], [z, z + h * 0.6], shell),
        };
        parts.push(thing);
        x = end + rng.random_range(0.02..0.15);
    }
}
