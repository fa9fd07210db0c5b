//! Procedural finishes of walls, floors and furniture: colour as a function of place on the surface.

use super::numeric::{Vec3, cell, fbm, hash, hsv, mix, noise, scaled, smoothstep, to_grid, unit, wave};
use super::picture::{self, Picture};

/// A place on a face: metres from its upper left corner as its viewer sees it, and the face's size.
#[derive(Debug, Clone, Copy)]
pub struct Spot {
    /// Metres to the right.
    pub x: f32,
    /// Metres down.
    pub y: f32,
    /// Width of the face in metres.
    pub width: f32,
    /// Height of the face in metres.
    pub height: f32,
}

/// What a surface sends back.
#[derive(Debug, Clone, Copy)]
pub struct Surface {
    /// Share of the incoming light that is reflected, per colour.
    pub albedo: Vec3,
    /// Light of its own, per colour.
    pub emission: Vec3,
}

/// A finish; colours are albedos in linear light.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Finish {
    /// Painted plaster with roller texture and faint stains; `skirting` adds a board at its foot.
    Plaster { colour: Vec3, skirting: bool },
    /// Wallpaper: stripes, lozenges or dots (`pattern` 0, 1, 2) in two colours, with a skirting board.
    Wallpaper { colour: Vec3, accent: Vec3, pattern: u32 },
    /// Brickwork, every brick of another shade.
    Brick { colour: Vec3 },
    /// Wooden boards laid along x.
    Planks { colour: Vec3 },
    /// Square floor tiles in two colours.
    Tiles { colour: Vec3, accent: Vec3 },
    /// Suspended ceiling of 60 cm panels.
    Ceiling,
    /// Planed wood with grain along the longer side.
    Wood { colour: Vec3 },
    /// Lacquer or plastic with grain, scratches and now and then a label.
    Lacquer { colour: Vec3 },
    /// Cabinet front: `doors` doors with gaps and handles.
    Doors { colour: Vec3, doors: u32 },
    /// Drawer front: `drawers` drawers one above the other, with handles and labels.
    Drawers { colour: Vec3, drawers: u32 },
    /// Woven cloth with a check in a second colour.
    Cloth { colour: Vec3, accent: Vec3 },
    /// Carpet with a border and an asymmetrical field.
    Rug { colour: Vec3, accent: Vec3 },
    /// A row of book spines.
    Books,
    /// Desk top strewn with papers.
    DeskTop { colour: Vec3 },
    /// Cardboard with tape and a shipping label.
    Carton,
    /// Panelled door with a handle and a sign.
    Door { colour: Vec3 },
    /// A keyboard.
    Keyboard,
    /// Ribs of a radiator.
    Radiator,
    /// A framed picture.
    Framed(Picture),
    /// A lit screen.
    Screen,
    /// A window to the outdoors.
    Window,
    /// A lamp's shining face.
    Lamp { light: Vec3 },
}

impl Finish {
    /// Samples per texel side that its finest detail needs.
    pub fn subsamples(&self) -> usize {
        match self {
            Self::Framed(_) | Self::Screen | Self::Window | Self::Books => 2,
            _ => 1,
        }
    }

    /// Colour at `spot`; `seed` tells faces of the same finish apart.
    pub fn at(&self, spot: Spot, seed: u32) -> Surface {
        let Spot { x, y, width, height } = spot;
        let albedo = match *self {
            Self::Plaster { colour, skirting } => {
                let c = plaster(x, y, colour, seed);
                if skirting { skirted(spot, c, seed) } else { c }
            }
            Self::Wallpaper { colour, accent, pattern } => {
                let share = match pattern % 3 {
                    0 => {
                        0.75 * smoothstep(0.13, 0.16, to_grid(x / 0.31))
                            + 0.25 * smoothstep(0.3, 0.34, to_grid(x / 0.045))
                    }
                    1 => {
                        let d = (to_grid((x + y) / 0.34)).min(to_grid((x - y) / 0.34));
                        1.0 - smoothstep(0.025, 0.05, d)
                    }
                    _ => {
                        let (i, j) = ((x / 0.16).floor(), (y / 0.16).floor());
                        let (dx, dy) = (
                            x / 0.16 - i - 0.3 - 0.4 * cell(i, j, seed),
                            y / 0.16 - j - 0.3 - 0.4 * cell(j, i, seed ^ 7),
                        );
                        let radius = 0.12 + 0.2 * cell(i, j, seed ^ 3);
                        1.0 - smoothstep(radius - 0.04, radius, (dx * dx + dy * dy).sqrt())
                    }
                };
                skirted(spot, plaster(x, y, mix(colour, accent, share), seed), seed)
            }
            Self::Brick { colour } => brick(spot, colour, seed),
            Self::Planks { colour } => planks(x, y, colour, seed),
            Self::Tiles { colour, accent } => {
                let (i, j) = ((x / 0.4).floor(), (y / 0.4).floor());
                let chosen = if cell(i, j, seed) > 0.55 { accent } else { colour };
                let veins =
                    (fbm(x * 5.0, y * 5.0, hash(i as i32 as u32, j as i32 as u32, seed), 5) - 0.5).abs();
                let body = scaled(chosen, 0.7 + 0.25 * cell(i, j, seed ^ 9) + 1.2 * veins);
                let joint = to_grid(x / 0.4).min(to_grid(y / 0.4));
                mix([0.12, 0.11, 0.1], body, smoothstep(0.006, 0.012, joint))
            }
            Self::Ceiling => {
                let speckle = noise(x * 70.0, y * 70.0, seed) * noise(x * 31.0, y * 31.0, seed ^ 5);
                let panel = 0.72 + 0.07 * cell((x / 0.6).floor(), (y / 0.6).floor(), seed);
                let stain = 0.22 * smoothstep(0.62, 0.8, fbm(x * 1.3, y * 1.3, seed ^ 11, 3));
                let body = [
                    panel - 0.6 * speckle * speckle - stain,
                    panel - 0.6 * speckle * speckle - 1.15 * stain,
                    panel - 0.62 * speckle * speckle - 1.5 * stain,
                ];
                mix([0.4; 3], body, smoothstep(0.012, 0.022, to_grid(x / 0.6).min(to_grid(y / 0.6))))
            }
            Self::Wood { colour } => {
                let (a, b) = if width >= height { (x, y) } else { (y, x) };
                edged(spot, wood(a, b, colour, seed))
            }
            Self::Lacquer { colour } => edged(spot, labelled(spot, lacquer(x, y, colour, seed), seed)),
            Self::Doors { colour, doors } => {
                let part = width / doors as f32;
                let i = (x / part).floor();
                let inside = (x - i * part).min((i + 1.0) * part - x).min(y).min(height - y);
                let side = if i as i32 % 2 == 0 { part * 0.88 } else { part * 0.12 };
                let handle = (x - i * part - side).abs() < 0.012 && (y - height * 0.5).abs() < 0.07;
                let body = scaled(wood(y, x, colour, seed ^ (i as u32)), 0.9 + 0.2 * cell(i, 1.0, seed));
                let body = labelled(spot, body, seed);
                if handle { [0.6, 0.6, 0.58] } else { grooved(body, inside) }
            }
            Self::Drawers { colour, drawers } => {
                let part = height / drawers as f32;
                let j = (y / part).floor();
                let (dx, dy) = (x - width * 0.5, y - (j + 0.5) * part);
                let inside = (y - j * part).min((j + 1.0) * part - y).min(x).min(width - x);
                let body = scaled(lacquer(x, y, colour, seed), 0.85 + 0.3 * cell(j, 2.0, seed));
                if dx.abs() < 0.06 && dy.abs() < 0.01 {
                    [0.08; 3]
                } else if (dx + width * 0.28).abs() < 0.035 && (dy + 0.01).abs() < 0.022 {
                    let ink = picture::glyphs(
                        (dx + width * 0.28 + 0.03) / 0.011,
                        (dy + 0.026) / 0.016,
                        hash(seed, j as u32, 4),
                    );
                    if ink { [0.05; 3] } else { [0.8, 0.78, 0.7] }
                } else {
                    grooved(body, inside)
                }
            }
            Self::Cloth { colour, accent } => {
                let weave =
                    0.8 + 0.2 * noise(x * 260.0, y * 90.0, seed) + 0.2 * noise(x * 90.0, y * 260.0, seed ^ 1);
                let check = 0.5 * smoothstep(0.3, 0.33, to_grid(x / 0.14 + 0.1))
                    + 0.5 * smoothstep(0.36, 0.39, to_grid(y / 0.17));
                let folds = 0.75 + 0.5 * fbm(x * 4.0, y * 4.0, seed ^ 2, 3);
                edged(spot, scaled(mix(colour, accent, check), weave * folds))
            }
            Self::Rug { colour, accent } => rug(spot, colour, accent, seed),
            Self::Books => picture::books(spot, seed),
            Self::DeskTop { colour } => picture::papers(spot, wood(x, y, colour, seed), seed),
            Self::Carton => {
                let ribs = 0.95 + 0.05 * wave(x / 0.011);
                let body = scaled([0.42, 0.27, 0.14], ribs * (0.8 + 0.4 * fbm(x * 9.0, y * 9.0, seed, 4)));
                let tape = (y - height * 0.5).abs() < 0.025;
                edged(
                    spot,
                    labelled(spot, if tape { mix(body, [0.6, 0.5, 0.33], 0.7) } else { body }, seed | 1),
                )
            }
            Self::Door { colour } => door(spot, colour, seed),
            Self::Keyboard => {
                let (i, j) = ((x / 0.019).floor(), (y / 0.019).floor());
                let key = (x / 0.019 - i - 0.5).abs().max((y / 0.019 - j - 0.5).abs()) < 0.4;
                if key { [0.12 + 0.2 * cell(i, j, seed); 3] } else { [0.03; 3] }
            }
            Self::Radiator => {
                let rib = 0.35 + 0.45 * smoothstep(0.08, 0.3, to_grid(x / 0.06));
                let top = smoothstep(0.0, 0.05, y);
                [rib * (0.8 + 0.2 * top), rib * (0.8 + 0.2 * top), rib * (0.76 + 0.2 * top)]
            }
            Self::Framed(picture) => picture.at(spot, seed),
            Self::Screen => {
                return Surface { albedo: [0.03; 3], emission: scaled(picture::screen(spot, seed), 0.75) };
            }
            Self::Window => return picture::window(spot, seed),
            Self::Lamp { light } => {
                let rim = smoothstep(0.0, 0.03, x.min(y).min(width - x).min(height - y));
                return Surface { albedo: [0.6; 3], emission: scaled(light, 0.25 + 0.75 * rim) };
            }
        };
        Surface { albedo: albedo.map(|a| a.clamp(0.01, 0.92)), emission: [0.0; 3] }
    }
}

fn plaster(x: f32, y: f32, colour: Vec3, seed: u32) -> Vec3 {
    let grain = noise(x * 90.0, y * 90.0, seed) + 0.7 * noise(x * 37.0, y * 37.0, seed ^ 1);
    let cloud = fbm(x * 1.1, y * 1.1, seed ^ 2, 4);
    let scuff = smoothstep(0.72, 0.85, fbm(x * 3.0, y * 7.0, seed ^ 3, 3));
    scaled(colour, 0.8 + 0.1 * grain + 0.3 * (cloud - 0.5) - 0.25 * scuff)
}

fn skirted(spot: Spot, colour: Vec3, seed: u32) -> Vec3 {
    let above = spot.height - spot.y;
    if above > 0.1 {
        return mix(scaled(colour, 0.6), colour, smoothstep(0.1, 0.11, above));
    }
    mix([0.1, 0.07, 0.05], wood(spot.x, spot.y, [0.35, 0.24, 0.15], seed), smoothstep(0.0, 0.012, above))
}

fn brick(spot: Spot, colour: Vec3, seed: u32) -> Vec3 {
    let (long, high) = (0.23, 0.075);
    let row = (spot.y / high).floor();
    let x = spot.x / long + 0.5 * (row - 2.0 * (row * 0.5).floor()) + 0.08 * cell(row, 0.0, seed ^ 4);
    let column = x.floor();
    let (dx, dy) = (to_grid(x) * long, to_grid(spot.y / high) * high);
    let shade = 0.5 + 0.9 * cell(column, row, seed);
    let warm = cell(column, row, seed ^ 8) - 0.5;
    let tint =
        [colour[0] * (1.0 + 0.25 * warm), colour[1] * (1.0 - 0.3 * warm), colour[2] * (1.0 - 0.3 * warm)];
    let rough = 0.7 + 0.6 * fbm(spot.x * 40.0, spot.y * 40.0, seed ^ 6, 3);
    let wobble = 0.003 * noise(spot.x * 60.0, spot.y * 60.0, seed ^ 5);
    let mortar = [0.42 * rough, 0.4 * rough, 0.36 * rough];
    skirted(
        spot,
        mix(mortar, scaled(tint, shade * rough), smoothstep(0.003, 0.008, dx.min(dy) + wobble)),
        seed,
    )
}

fn planks(x: f32, y: f32, colour: Vec3, seed: u32) -> Vec3 {
    let row = (y / 0.13).floor();
    let along = x / 1.15 + cell(row, 3.0, seed) * 7.0;
    let board = along.floor();
    let id = hash(row as i32 as u32, board as i32 as u32, seed);
    let joint = (to_grid(y / 0.13) * 0.13).min(to_grid(along) * 1.15);
    let body = scaled(wood(x, y, colour, id), 0.6 + 0.7 * unit(id));
    mix(scaled(body, 0.2), body, smoothstep(0.001, 0.004, joint))
}

/// Grain that runs along `a`.
fn wood(a: f32, b: f32, colour: Vec3, seed: u32) -> Vec3 {
    let drift = fbm(a * 1.2, b * 6.0, seed, 3);
    let rings = to_grid(b * 9.0 + drift * 5.0) * 2.0;
    let fibre = noise(a * 9.0, b * 220.0, seed ^ 1);
    let (ka, kb) = ((a / 0.55).floor(), (b / 0.3).floor());
    let (da, db) = (a / 0.55 - ka - 0.5, (b / 0.3 - kb - 0.5) * 2.2);
    let has_knot = if cell(ka, kb, seed ^ 2) > 0.7 { 1.0 } else { 0.0 };
    let knot = has_knot * (1.0 - smoothstep(0.02, 0.12, (da * da + db * db).sqrt()));
    let tone = 0.72 + 0.28 * rings + 0.22 * (fibre - 0.5) - 0.5 * knot;
    [colour[0] * tone, colour[1] * tone * (0.94 + 0.06 * rings), colour[2] * tone * (0.88 + 0.12 * rings)]
}

fn lacquer(x: f32, y: f32, colour: Vec3, seed: u32) -> Vec3 {
    let cloud = fbm(x * 3.5, y * 3.5, seed, 4);
    let scratch = smoothstep(0.46, 0.5, to_grid(x * 3.0 + 2.0 * noise(x * 2.0, y * 2.0, seed ^ 1)))
        * smoothstep(0.7, 0.8, noise(x * 8.0, y * 8.0, seed ^ 2));
    scaled(colour, 0.78 + 0.4 * cloud + 0.25 * scratch + 0.08 * noise(x * 120.0, y * 120.0, seed ^ 3))
}

/// A paper label with print, on faces large enough, for every other seed.
fn labelled(spot: Spot, body: Vec3, seed: u32) -> Vec3 {
    if seed.is_multiple_of(2) || spot.width < 0.22 || spot.height < 0.18 {
        return body;
    }
    let (w, h) = (0.14f32.min(spot.width * 0.5), 0.1f32.min(spot.height * 0.4));
    let x = spot.x - (spot.width - w) * (0.15 + 0.7 * unit(hash(seed, 1, 1)));
    let y = spot.y - (spot.height - h) * (0.15 + 0.7 * unit(hash(seed, 2, 1)));
    if x < 0.0 || y < 0.0 || x > w || y > h {
        return body;
    }
    let band = y < h * 0.3;
    let ink = !band && picture::glyphs(x / 0.014, y / 0.022, seed);
    if band {
        hsv(unit(hash(seed, 3, 1)), 0.8, 0.8)
    } else if ink {
        [0.05; 3]
    } else {
        [0.78, 0.77, 0.72]
    }
}

/// Worn, lighter edges: gives boxes an outline as real bevels do.
fn edged(spot: Spot, body: Vec3) -> Vec3 {
    let edge = spot.x.min(spot.y).min(spot.width - spot.x).min(spot.height - spot.y);
    scaled(body, 1.25 - 0.25 * smoothstep(0.004, 0.014, edge))
}

fn grooved(body: Vec3, inside: f32) -> Vec3 {
    scaled(
        body,
        0.25 + 0.75 * smoothstep(0.003, 0.009, inside) + 0.15 * (1.0 - smoothstep(0.01, 0.02, inside)),
    )
}

fn rug(spot: Spot, colour: Vec3, accent: Vec3, seed: u32) -> Vec3 {
    let edge = spot.x.min(spot.y).min(spot.width - spot.x).min(spot.height - spot.y);
    let (i, j) = ((spot.x / 0.17).floor(), (spot.y / 0.17).floor());
    let (dx, dy) = ((spot.x / 0.17 - i - 0.5).abs(), (spot.y / 0.17 - j - 0.5).abs());
    let shape = if cell(i, j, seed) > 0.5 { dx + dy } else { dx.max(dy) * 1.4 };
    let motif = hsv(cell(i, j, seed ^ 3), 0.65, 0.35 + 0.5 * cell(i, j, seed ^ 4));
    let field = if shape < 0.2 + 0.3 * cell(i, j, seed ^ 2) { motif } else { colour };
    let band = |lo: f32, hi: f32| edge > lo && edge < hi;
    let c = if band(0.04, 0.1) || band(0.13, 0.15) {
        accent
    } else if edge < 0.15 {
        scaled(colour, 0.6)
    } else {
        field
    };
    scaled(
        c,
        0.65 + 0.45 * noise(spot.x * 120.0, spot.y * 120.0, seed)
            + 0.3 * (fbm(spot.x * 3.0, spot.y * 3.0, seed ^ 6, 3) - 0.4),
    )
}

fn door(spot: Spot, colour: Vec3, seed: u32) -> Vec3 {
    let Spot { x, y, width, height } = spot;
    let panel = |top: f32, bottom: f32| {
        (x - 0.13).min(width - 0.13 - x).min(y - top * height).min(bottom * height - y)
    };
    let inset = panel(0.06, 0.46).max(panel(0.54, 0.93));
    let frame = x.min(width - x).min(y);
    let (hx, hy) = (x - width * 0.9, y - height * 0.5);
    if hx * hx + hy * hy < 0.001 || (hy.abs() < 0.012 && hx < 0.0 && hx > -0.12) {
        return [0.62, 0.55, 0.35];
    }
    let (sx, sy) = (x - width * 0.5 + 0.14, y - height * 0.2);
    if (0.0..0.28).contains(&sx) && (0.0..0.11).contains(&sy) {
        let ink = picture::glyphs(sx / 0.035, (sy - 0.015) / 0.045, seed);
        return if ink { [0.85; 3] } else { [0.05, 0.12, 0.3] };
    }
    let body = wood(y, x, colour, seed);
    let moulding = smoothstep(0.0, 0.012, inset.abs()) * smoothstep(0.05, 0.06, frame);
    scaled(body, (0.4 + 0.6 * moulding) * if inset > 0.0 { 0.85 } else { 1.0 })
}
