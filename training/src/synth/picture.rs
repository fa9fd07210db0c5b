//! Posters, screens, windows, book rows and papers: the distinctive parts of the room.

use super::material::{Spot, Surface};
use super::numeric::{Vec3, cell, fbm, hash, hsv, mix, noise, scaled, smoothstep, to_grid, unit, wave};

/// What a framed picture shows; its seed makes each one different.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Picture {
    /// Hills, sky and sun.
    Landscape,
    /// Overlapping discs, bars and triangles.
    Abstract,
    /// A headline, a figure and columns of text.
    TextSheet,
    /// Coloured rectangles between black bars.
    Blocks,
    /// A map with contour lines and coasts.
    Map,
    /// Coloured cells with dark borders.
    Cells,
    /// Concentric rings around moved centres.
    Rings,
}

/// All kinds, for drawing one by number.
pub const PICTURES: [Picture; 7] = [
    Picture::Abstract,
    Picture::TextSheet,
    Picture::Landscape,
    Picture::Blocks,
    Picture::Map,
    Picture::Cells,
    Picture::Rings,
];

impl Picture {
    /// Colour of the picture with its frame and mount.
    pub fn at(self, spot: Spot, seed: u32) -> Vec3 {
        let Spot { x, y, width, height } = spot;
        let edge = x.min(y).min(width - x).min(height - y);
        if edge < 0.022 {
            let frame = hsv(unit(hash(seed, 77, 0)), 0.35, 0.15 + 0.6 * unit(hash(seed, 78, 0)));
            return scaled(
                frame,
                0.6 + 0.6 * smoothstep(0.0, 0.012, edge) + 0.2 * noise(x * 90.0, y * 90.0, seed),
            );
        }
        let mount = if unit(hash(seed, 79, 0)) > 0.5 { 0.05 } else { 0.022 };
        if edge < mount {
            return [0.8, 0.79, 0.75];
        }
        let (w, h) = (width - 2.0 * mount, height - 2.0 * mount);
        let inner = Spot { x: x - mount, y: y - mount, width: w, height: h };
        let c = match self {
            Self::Landscape => landscape(inner, seed),
            Self::Abstract => shapes(inner, seed),
            Self::TextSheet => text_sheet(inner, seed),
            Self::Blocks => blocks(inner, seed),
            Self::Map => map(inner, seed),
            Self::Cells => cells(inner, seed),
            Self::Rings => rings(inner, seed),
        };
        scaled(c, 0.92 + 0.12 * noise(x * 150.0, y * 150.0, seed))
    }
}

/// Whether there is ink at (`column`, `line`), measured in character cells, in a block of random glyphs
/// with words, indents and ragged line ends.
pub fn glyphs(column: f32, line: f32, seed: u32) -> bool {
    let (i, j) = (column.floor(), line.floor());
    if column < 0.0 || line < 0.0 || cell(i, j, seed) < 0.17 || cell(0.0, j, seed ^ 21) < 0.06 {
        return false;
    }
    let (gx, gy) = (((column - i) * 6.0) as u32, ((line - j) * 9.0) as u32);
    if gx >= 5 || !(1..8).contains(&gy) {
        return false;
    }
    // Letters: a stem or a bowl from a small alphabet, so that print looks like print and not like snow.
    let letter = hash(i as i32 as u32, j as i32 as u32, seed ^ 5);
    let stems = [gx == 0, gx == 4, gx == 2];
    let bars = [gy == 1, gy == 4, gy == 7];
    let bit = |k: u32| (letter >> k) & 1 == 1;
    (stems[0] && bit(3))
        || (stems[1] && bit(4))
        || (stems[2] && bit(5) && bit(6))
        || (bars[0] && bit(7))
        || (bars[1] && bit(8))
        || (bars[2] && bit(9))
        || (gx == gy.saturating_sub(2) && bit(10) && bit(11))
}

/// A row of book spines, some leaning gaps between them.
pub fn books(spot: Spot, seed: u32) -> Vec3 {
    let pitch = 0.034;
    let slot = spot.x / pitch + 0.35 * (cell((spot.x / pitch).floor(), 9.0, seed) - 0.5);
    let i = slot.floor();
    let id = hash(i as i32 as u32, 17, seed);
    let top = spot.height * 0.35 * unit(hash(id, 1, 0)) * unit(hash(id, 2, 0));
    if spot.y < top || unit(hash(id, 3, 0)) < 0.07 {
        return [0.025, 0.02, 0.018];
    }
    let across = slot - i;
    let colour =
        hsv(unit(hash(id, 4, 0)), 0.25 + 0.7 * unit(hash(id, 5, 0)), 0.2 + 0.7 * unit(hash(id, 6, 0)));
    let round = 0.45 + 0.55 * smoothstep(0.0, 0.25, across.min(1.0 - across));
    let down = spot.y - top;
    let band = to_grid(down / (0.05 + 0.08 * unit(hash(id, 7, 0)))) < 0.06;
    let title = (0.25..0.75).contains(&across) && glyphs((down - 0.03) / 0.012, (across - 0.25) * 2.0, id);
    let ink = if unit(hash(id, 8, 0)) > 0.4 { [0.8, 0.75, 0.5] } else { [0.04; 3] };
    scaled(if band || title { ink } else { colour }, round)
}

/// Sheets of paper and coloured folders on a table of the given colour.
pub fn papers(spot: Spot, table: Vec3, seed: u32) -> Vec3 {
    let mut colour = table;
    let count = 3 + (spot.width * spot.height * 7.0) as u32;
    for k in 0..count {
        let id = hash(seed, k, 91);
        let (cx, cy) = (
            spot.width * (0.08 + 0.84 * unit(hash(id, 1, 0))),
            spot.height * (0.1 + 0.8 * unit(hash(id, 2, 0))),
        );
        let sin = 0.7 * (unit(hash(id, 3, 0)) - 0.5);
        let cos = (1.0 - sin * sin).sqrt();
        let (dx, dy) = (spot.x - cx, spot.y - cy);
        let (px, py) = (cos * dx + sin * dy + 0.105, cos * dy - sin * dx + 0.148);
        if (0.0..0.21).contains(&px) && (0.0..0.297).contains(&py) {
            let folder = unit(hash(id, 4, 0)) > 0.6;
            colour = if folder {
                scaled(hsv(unit(hash(id, 5, 0)), 0.8, 0.75), 0.9 + 0.2 * noise(px * 60.0, py * 60.0, id))
            } else if px > 0.02
                && px < 0.19
                && py > 0.03
                && glyphs((px - 0.02) / 0.011, (py - 0.03) / 0.017, id)
            {
                [0.12; 3]
            } else {
                [0.8, 0.8, 0.78]
            };
        }
    }
    colour
}

/// A screen with windows, text and a chart; light, not albedo.
pub fn screen(spot: Spot, seed: u32) -> Vec3 {
    let Spot { x, y, width, height } = spot;
    if x.min(y).min(width - x).min(height - y) < 0.014 {
        return [0.0; 3];
    }
    if y > height - 0.03 {
        return [0.03, 0.03, 0.05];
    }
    let split = width * (0.35 + 0.3 * unit(hash(seed, 1, 3)));
    if x < split {
        let ink = glyphs((x - 0.02) / 0.009, (y - 0.02) / 0.015, seed);
        let tone = hsv(cell(0.0, ((y - 0.02) / 0.015).floor(), seed), 0.5, 0.9);
        return if ink { tone } else { [0.02, 0.025, 0.04] };
    }
    let bar = ((x - split) / 0.02).floor();
    let level = (height - y) / height;
    if level < 0.15 + 0.7 * cell(bar, 1.0, seed) && to_grid((x - split) / 0.02) > 0.1 {
        return hsv(0.3 + 0.5 * cell(bar, 1.0, seed), 0.7, 0.9);
    }
    [0.55, 0.6, 0.62]
}

/// A window: frame and bars, and behind them sky, clouds and a skyline that shine.
pub fn window(spot: Spot, seed: u32) -> Surface {
    let Spot { x, y, width, height } = spot;
    let edge = x.min(y).min(width - x).min(height - y);
    let middle = (x - width * 0.5).abs().min((y - height * 0.36).abs());
    if edge < 0.06 || middle < 0.022 {
        let shade = 0.6 + 0.25 * smoothstep(0.0, 0.02, edge.min((edge - 0.06).abs()));
        return Surface { albedo: [shade, shade, shade * 0.96], emission: [0.0; 3] };
    }
    let (u, v) = (x / width, y / height);
    let cloud = smoothstep(0.45, 0.7, fbm(u * 3.0, v * 5.0, seed, 5));
    let sky = mix(mix([0.28, 0.5, 0.95], [0.75, 0.85, 1.0], v), [1.0, 1.0, 1.0], cloud);
    let block = (u * 9.0).floor();
    let roof = 0.42 + 0.4 * cell(block, 0.0, seed ^ 3);
    let light = if v > roof {
        let lit = to_grid(u * 45.0) > 0.2 && to_grid(v * 24.0) > 0.25;
        let wall = hsv(cell(block, 1.0, seed ^ 3), 0.35, 0.35 + 0.35 * cell(block, 2.0, seed ^ 3));
        if lit { scaled(wall, 0.35) } else { wall }
    } else {
        scaled(sky, 1.35)
    };
    Surface { albedo: [0.05; 3], emission: scaled(light, 1.5) }
}

fn landscape(s: Spot, seed: u32) -> Vec3 {
    let (u, v) = (s.x / s.width, s.y / s.height);
    let hue = unit(hash(seed, 1, 0));
    let (sx, sy) = (u - 0.2 - 0.6 * unit(hash(seed, 2, 0)), (v - 0.25) * s.height / s.width);
    let sun = 1.0 - smoothstep(0.07, 0.085, (sx * sx + sy * sy).sqrt());
    let mut c = mix(mix(hsv(hue, 0.55, 0.9), hsv(hue + 0.12, 0.35, 1.0), v * 1.6), [0.9, 0.75, 0.3], sun);
    for layer in 0..4u32 {
        let f = layer as f32;
        let ridge = 0.35 + 0.14 * f + 0.3 * (fbm(u * (2.5 + f), f, seed ^ (layer + 40), 4) - 0.5);
        if v > ridge {
            let green = hsv(hue + 0.3 + 0.13 * f, 0.6, 0.75 - 0.15 * f);
            c = scaled(green, 0.7 + 0.6 * fbm(u * 30.0, v * 30.0, seed ^ layer, 3));
        }
    }
    c
}

fn shapes(s: Spot, seed: u32) -> Vec3 {
    let mut c = hsv(unit(hash(seed, 0, 1)), 0.25, 0.9);
    for k in 0..13u32 {
        let r = |n: u32| unit(hash(seed, k * 16 + n, 2));
        let (dx, dy) = (s.x - r(1) * s.width, s.y - r(2) * s.height);
        let size = s.width * (0.06 + 0.2 * r(3));
        let inside = match (r(4) * 4.0) as u32 {
            0 => dx * dx + dy * dy < size * size,
            1 => dx.abs() < size * 0.25 && dy.abs() < size * 1.7,
            2 => dy > -size && dx.abs() < (size - dy) * 0.5 && dy < size,
            _ => {
                let d = (dx * dx + dy * dy).sqrt();
                d < size && d > size * 0.7
            }
        };
        if inside {
            c = hsv(r(5), 0.85, 0.25 + 0.75 * r(6));
        }
    }
    c
}

fn text_sheet(s: Spot, seed: u32) -> Vec3 {
    let (u, v) = (s.x / s.width, s.y / s.height);
    let dark = unit(hash(seed, 0, 5)) > 0.6;
    let (paper, ink) = if dark {
        (hsv(unit(hash(seed, 1, 5)), 0.7, 0.35), [0.85; 3])
    } else {
        ([0.82, 0.81, 0.76], [0.04; 3])
    };
    let headline = hsv(unit(hash(seed, 2, 5)), 0.9, 0.7);
    if v < 0.2 {
        let written = glyphs((s.x - 0.03) / (s.width / 9.0), (v - 0.02) / 0.16, seed);
        return if written { if dark { ink } else { headline } } else { paper };
    }
    let right = unit(hash(seed, 3, 5)) > 0.5;
    let figure_x = if right { u - 0.52 } else { u - 0.05 };
    if (0.0..0.43).contains(&figure_x) && (0.24..0.58).contains(&v) {
        let level = 0.58 - 0.3 * fbm(figure_x * 14.0, 0.0, seed ^ 9, 4);
        return if v > level { headline } else { scaled(headline, 0.25) };
    }
    let column = if u < 0.5 { s.x - 0.05 * s.width } else { s.x - 0.53 * s.width };
    let written = column > 0.0
        && column < s.width * 0.42
        && glyphs(column / 0.013, (s.y - s.height * 0.23) / 0.021, seed ^ u32::from(u < 0.5));
    if written { ink } else { paper }
}

fn blocks(s: Spot, seed: u32) -> Vec3 {
    let (mut x0, mut y0, mut w, mut h) = (0.0f32, 0.0f32, s.width, s.height);
    let mut id = hash(seed, 5, 5);
    for depth in 0..5u32 {
        let cut = 0.25 + 0.5 * unit(hash(id, 1, depth));
        let lower = if (w > h) ^ (unit(hash(id, 3, depth)) > 0.85) {
            let lower = s.x - x0 < w * cut;
            if lower {
                w *= cut
            } else {
                x0 += w * cut;
                w *= 1.0 - cut
            }
            lower
        } else {
            let lower = s.y - y0 < h * cut;
            if lower {
                h *= cut
            } else {
                y0 += h * cut;
                h *= 1.0 - cut
            }
            lower
        };
        id = hash(id, u32::from(lower), depth);
    }
    let edge = (s.x - x0).min(x0 + w - s.x).min(s.y - y0).min(y0 + h - s.y);
    if edge < 0.006 {
        return [0.03; 3];
    }
    if unit(hash(id, 9, 9)) < 0.3 {
        [0.82, 0.82, 0.78]
    } else {
        hsv(unit(hash(id, 8, 9)), 0.85, 0.3 + 0.65 * unit(hash(id, 7, 9)))
    }
}

fn map(s: Spot, seed: u32) -> Vec3 {
    let height = fbm(s.x * 5.5, s.y * 5.5, seed, 5);
    let hue = unit(hash(seed, 4, 4));
    let grid = to_grid(s.x / 0.1).min(to_grid(s.y / 0.1)) < 0.02;
    let contour = to_grid(height * 22.0) < 0.1;
    let c = if height < 0.47 {
        hsv(0.55 + 0.1 * hue, 0.6, 0.5 + 0.7 * height)
    } else {
        hsv(0.33 - 0.6 * (height - 0.45), 0.5, 0.55 + 0.6 * (height - 0.45))
    };
    if grid {
        scaled(c, 0.5)
    } else if contour {
        scaled(c, 0.65)
    } else {
        c
    }
}

fn cells(s: Spot, seed: u32) -> Vec3 {
    let (x, y) = (s.x / 0.11, s.y / 0.11);
    let (i, j) = (x.floor(), y.floor());
    let (mut first, mut second, mut owner) = (9.0f32, 9.0f32, 0);
    for dj in -1..=1 {
        for di in -1..=1 {
            let (ci, cj) = (i + di as f32, j + dj as f32);
            let (dx, dy) = (x - ci - cell(ci, cj, seed), y - cj - cell(ci, cj, seed ^ 1));
            let d = (dx * dx + dy * dy).sqrt();
            if d < first {
                second = first;
                first = d;
                owner = hash(ci as i32 as u32, cj as i32 as u32, seed ^ 2);
            } else if d < second {
                second = d;
            }
        }
    }
    let c = hsv(unit(hash(seed, 6, 6)) + 0.35 * unit(owner), 0.75, 0.25 + 0.7 * unit(hash(owner, 1, 1)));
    scaled(c, 0.15 + 0.85 * smoothstep(0.03, 0.09, second - first))
}

fn rings(s: Spot, seed: u32) -> Vec3 {
    let r = |n: u32| unit(hash(seed, n, 12));
    let distance = |cx: f32, cy: f32| {
        let (dx, dy) = (s.x - cx * s.width, s.y - cy * s.height);
        (dx * dx + dy * dy).sqrt()
    };
    let (a, b) = (distance(r(1), r(2)), distance(r(3), r(4)));
    let (near, hue) = if a < b { (a, r(5)) } else { (b, r(6)) };
    let ring = (near / 0.045).floor();
    let tone = 0.5 + 0.5 * wave(near / 0.09);
    mix(hsv(hue + 0.17 * ring, 0.8, 0.9), hsv(hue + 0.5, 0.7, 0.2), if tone > 0.5 { 1.0 } else { 0.0 })
}
