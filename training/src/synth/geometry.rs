//! The room as boxes: ray casting, clearance and the rectangles that carry textures.
//!
//! World frame: origin on the floor in the middle of the room, z up, metres. Furniture stands in groups of
//! boxes that share one rotation about z; a ray is turned into a group's frame once and then meets
//! axis-aligned boxes only.

use super::numeric::Vec3;

/// Faces of a box by outward normal: -x, +x, -y, +y, -z, +z.
pub const FACES: usize = 6;

/// An axis-aligned box in the frame of its group.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cuboid {
    /// Corner with the smallest coordinates.
    pub min: Vec3,
    /// Corner with the largest coordinates.
    pub max: Vec3,
}

/// A rigid group of boxes, turned about z.
#[derive(Debug, Clone, PartialEq)]
pub struct Group {
    /// What it is: `desk`, `picture`.
    pub name: &'static str,
    /// Origin of the group's frame in the world.
    pub origin: Vec3,
    /// Cosine and sine of the group's rotation about z.
    pub turn: [f32; 2],
    /// First of its boxes in [`Geometry::boxes`].
    pub first: usize,
    /// One past its last box.
    pub last: usize,
    /// Box around all of its boxes, in its own frame.
    pub bound: Cuboid,
    /// Centre of a sphere around the group, in the world.
    pub sphere_centre: Vec3,
    /// Radius of that sphere.
    pub sphere_radius: f32,
}

/// A rectangle that carries a texture: u to the right and v down as its viewer sees it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rect {
    /// Where u = v = 0 lies, in the frame of the group.
    pub corner: Vec3,
    /// Axis of the normal, of u and of v.
    pub axes: [usize; 3],
    /// Direction along those axes, +1 or -1.
    pub signs: [f32; 3],
    /// Length along u and v in metres.
    pub length: [f32; 2],
    /// The group it belongs to; `None` for the walls, floor and ceiling.
    pub group: Option<usize>,
}

/// Where a ray ends.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// Distance in units of the ray's direction.
    pub t: f32,
    /// Index into [`Geometry::rects`].
    pub face: usize,
    /// Place on the face, 0..1.
    pub uv: [f32; 2],
}

/// All shapes of a room.
#[derive(Debug, Clone, Default)]
pub struct Geometry {
    /// Extent of the room in x, y, z; x and y are symmetrical about 0, z starts at 0.
    pub size: Vec3,
    /// Groups of furniture.
    pub groups: Vec<Group>,
    /// The boxes of all groups.
    pub boxes: Vec<Cuboid>,
    /// Textured rectangles: 6 of the room (-x, +x, -y, +y wall, floor, ceiling), then 6 for every box.
    pub rects: Vec<Rect>,
}

impl Rect {
    /// The side with normal number `normal` (-x, +x, -y, +y, -z, +z) in the plane where a box would have it.
    pub fn of_box(shape: &Cuboid, normal: usize, group: Option<usize>) -> Self {
        let plane = if normal.is_multiple_of(2) { shape.min } else { shape.max };
        Self::facing(shape, normal, plane, group)
    }

    /// The inside of a room's wall, floor or ceiling number `side`: its normal points inwards.
    pub fn of_room(shape: &Cuboid, side: usize) -> Self {
        let plane = if side.is_multiple_of(2) { shape.min } else { shape.max };
        Self::facing(shape, side ^ 1, plane, None)
    }

    fn facing(shape: &Cuboid, normal: usize, plane: Vec3, group: Option<usize>) -> Self {
        let (axes, u_sign, v_sign) = match normal {
            0 => ([0, 1, 2], -1.0, -1.0),
            1 => ([0, 1, 2], 1.0, -1.0),
            2 => ([1, 0, 2], 1.0, -1.0),
            3 => ([1, 0, 2], -1.0, -1.0),
            4 => ([2, 0, 1], 1.0, 1.0),
            _ => ([2, 0, 1], 1.0, -1.0),
        };
        let signs = [if normal.is_multiple_of(2) { -1.0 } else { 1.0 }, u_sign, v_sign];
        let mut corner = plane;
        let mut length = [0.0; 2];
        for k in 0..2 {
            let axis = axes[k + 1];
            corner[axis] = if signs[k + 1] > 0.0 { shape.min[axis] } else { shape.max[axis] };
            length[k] = shape.max[axis] - shape.min[axis];
        }
        Self { corner, axes, signs, length, group }
    }

    /// The point at (u, v), each 0..1, in the frame of the group.
    pub fn point(&self, u: f32, v: f32) -> Vec3 {
        let mut p = self.corner;
        p[self.axes[1]] += self.signs[1] * self.length[0] * u;
        p[self.axes[2]] += self.signs[2] * self.length[1] * v;
        p
    }

    /// The outward normal in the frame of the group.
    pub fn normal(&self) -> Vec3 {
        let mut n = [0.0; 3];
        n[self.axes[0]] = self.signs[0];
        n
    }

    /// (u, v) of a point on the rectangle.
    pub fn uv(&self, p: Vec3) -> [f32; 2] {
        let along = |k: usize| {
            let axis = self.axes[k];
            (p[axis] - self.corner[axis]) * self.signs[k] / self.length[k - 1]
        };
        [along(1), along(2)]
    }

    /// Change of (u, v) for a step `d` within the plane.
    pub fn uv_step(&self, d: Vec3) -> [f32; 2] {
        [d[self.axes[1]] * self.signs[1] / self.length[0], d[self.axes[2]] * self.signs[2] / self.length[1]]
    }
}

impl Group {
    /// A direction of the world in the frame of the group.
    pub fn turned_in(&self, d: Vec3) -> Vec3 {
        let [c, s] = self.turn;
        [c * d[0] + s * d[1], c * d[1] - s * d[0], d[2]]
    }

    /// A direction of the group in the world.
    pub fn turned_out(&self, d: Vec3) -> Vec3 {
        let [c, s] = self.turn;
        [c * d[0] - s * d[1], s * d[0] + c * d[1], d[2]]
    }

    /// A point of the world in the frame of the group.
    pub fn point_in(&self, p: Vec3) -> Vec3 {
        self.turned_in([p[0] - self.origin[0], p[1] - self.origin[1], p[2] - self.origin[2]])
    }

    /// A point of the group in the world.
    pub fn point_out(&self, p: Vec3) -> Vec3 {
        let q = self.turned_out(p);
        [q[0] + self.origin[0], q[1] + self.origin[1], q[2] + self.origin[2]]
    }
}

impl Geometry {
    /// An empty room.
    pub fn new(size: Vec3) -> Self {
        let shape = Cuboid {
            min: [-size[0] / 2.0, -size[1] / 2.0, 0.0],
            max: [size[0] / 2.0, size[1] / 2.0, size[2]],
        };
        let rects = (0..FACES).map(|side| Rect::of_room(&shape, side)).collect();
        Self { size, groups: Vec::new(), boxes: Vec::new(), rects }
    }

    /// Adds a group of boxes given in its own frame.
    pub fn add(&mut self, name: &'static str, origin: Vec3, turn: [f32; 2], boxes: &[Cuboid]) {
        let first = self.boxes.len();
        let index = self.groups.len();
        let mut bound = boxes[0];
        for shape in boxes {
            for k in 0..3 {
                bound.min[k] = bound.min[k].min(shape.min[k]);
                bound.max[k] = bound.max[k].max(shape.max[k]);
            }
            self.boxes.push(*shape);
            self.rects.extend((0..FACES).map(|normal| Rect::of_box(shape, normal, Some(index))));
        }
        let half = |k: usize| (bound.max[k] - bound.min[k]) / 2.0;
        let radius = (half(0) * half(0) + half(1) * half(1) + half(2) * half(2)).sqrt();
        let middle = [0, 1, 2].map(|k| (bound.min[k] + bound.max[k]) / 2.0);
        let mut group = Group {
            name,
            origin,
            turn,
            first,
            last: self.boxes.len(),
            bound,
            sphere_centre: [0.0; 3],
            sphere_radius: radius * 1.001 + 1e-3,
        };
        group.sphere_centre = group.point_out(middle);
        self.groups.push(group);
    }

    /// The first surface that the ray `origin + t * direction` meets, among the room and the given groups.
    pub fn trace(&self, origin: Vec3, direction: Vec3, groups: impl Iterator<Item = usize>) -> Hit {
        let (mut t, mut face, mut best_point) = self.trace_room(origin, direction);
        for index in groups {
            let group = &self.groups[index];
            let (o, d) = (group.point_in(origin), group.turned_in(direction));
            let inverse = d.map(|x| 1.0 / x);
            if group.last - group.first > 1 {
                match slab(&group.bound, o, inverse) {
                    Some((near, far, _)) if far > 0.0 && near < t => {}
                    _ => continue,
                }
            }
            for index in group.first..group.last {
                if let Some((near, _, axis)) = slab(&self.boxes[index], o, inverse)
                    && near > 1e-4
                    && near < t
                {
                    t = near;
                    face = FACES + index * FACES + 2 * axis + usize::from(d[axis] < 0.0);
                    best_point = [o[0] + d[0] * near, o[1] + d[1] * near, o[2] + d[2] * near];
                }
            }
        }
        Hit { t, face, uv: self.rects[face].uv(best_point) }
    }

    /// The first surface among everything in the room.
    pub fn trace_all(&self, origin: Vec3, direction: Vec3) -> Hit {
        self.trace(origin, direction, 0..self.groups.len())
    }

    /// Whether any furniture lies between two points.
    pub fn blocked(&self, from: Vec3, to: Vec3) -> bool {
        let direction = [to[0] - from[0], to[1] - from[1], to[2] - from[2]];
        self.groups.iter().any(|group| {
            let (o, inverse) = (group.point_in(from), group.turned_in(direction).map(|x| 1.0 / x));
            let meets = |shape: &Cuboid| {
                slab(shape, o, inverse).is_some_and(|(near, far, _)| far > 1e-4 && near < 0.9999)
            };
            meets(&group.bound) && self.boxes[group.first..group.last].iter().any(meets)
        })
    }

    /// Distance in metres from a point to the nearest wall, floor, ceiling or furniture; not positive inside one.
    pub fn clearance_m(&self, p: Vec3) -> f32 {
        let [w, d, h] = self.size;
        let mut nearest = (w / 2.0 - p[0].abs()).min(d / 2.0 - p[1].abs()).min(p[2]).min(h - p[2]);
        for group in &self.groups {
            let q = group.point_in(p);
            for shape in &self.boxes[group.first..group.last] {
                let outside = [0, 1, 2].map(|k| (shape.min[k] - q[k]).max(q[k] - shape.max[k]));
                let beyond = outside.map(|x| x.max(0.0));
                let inside = outside[0].max(outside[1]).max(outside[2]).min(0.0);
                let distance = (beyond[0] * beyond[0] + beyond[1] * beyond[1] + beyond[2] * beyond[2]).sqrt();
                nearest = nearest.min(distance + inside);
            }
        }
        nearest
    }

    /// The rectangle's point (u, v) in the world.
    pub fn world_point(&self, face: usize, u: f32, v: f32) -> Vec3 {
        let p = self.rects[face].point(u, v);
        self.rects[face].group.map_or(p, |group| self.groups[group].point_out(p))
    }

    /// The rectangle's outward normal in the world.
    pub fn world_normal(&self, face: usize) -> Vec3 {
        let n = self.rects[face].normal();
        self.rects[face].group.map_or(n, |group| self.groups[group].turned_out(n))
    }

    fn trace_room(&self, o: Vec3, d: Vec3) -> (f32, usize, Vec3) {
        let half = [self.size[0] / 2.0, self.size[1] / 2.0];
        let (lo, hi) = ([-half[0], -half[1], 0.0], [half[0], half[1], self.size[2]]);
        let (mut t, mut face) = (f32::INFINITY, 0);
        for k in 0..3 {
            let wall = if d[k] > 0.0 { hi[k] } else { lo[k] };
            let reach = (wall - o[k]) / d[k];
            if d[k] != 0.0 && reach < t {
                t = reach;
                face = 2 * k + usize::from(d[k] > 0.0);
            }
        }
        (t, face, [o[0] + d[0] * t, o[1] + d[1] * t, o[2] + d[2] * t])
    }
}

/// Entry and exit of a ray through a box and the axis of entry; `None` when it misses.
fn slab(shape: &Cuboid, o: Vec3, inverse: Vec3) -> Option<(f32, f32, usize)> {
    let (mut near, mut far, mut axis) = (f32::NEG_INFINITY, f32::INFINITY, 0);
    for k in 0..3 {
        let a = (shape.min[k] - o[k]) * inverse[k];
        let b = (shape.max[k] - o[k]) * inverse[k];
        // `min` and `max` ignore the NaN of a ray that runs inside a face's plane.
        let (entry, exit) = (a.min(b), a.max(b));
        if entry > near {
            near = entry;
            axis = k;
        }
        far = far.min(exit);
    }
    (near <= far).then_some((near, far, axis))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn room() -> Geometry {
        let mut room = Geometry::new([6.0, 4.0, 2.5]);
        room.add(
            "cube",
            [1.0, 0.5, 0.0],
            [0.6, 0.8],
            &[Cuboid { min: [-0.5, -0.5, 0.0], max: [0.5, 0.5, 1.0] }],
        );
        room
    }

    #[test]
    fn rays_end_where_they_should() {
        let room = room();
        let up = room.trace_all([1.0, 0.5, 1.2], [0.0, 0.0, 1.0]);
        assert!((up.t - 1.3).abs() < 1e-6 && up.face == 5);
        let down = room.trace_all([1.0, 0.5, 1.2], [0.0, 0.0, -1.0]);
        assert!((down.t - 0.2).abs() < 1e-6 && down.face == FACES + 5);
        // Along the cube's own x axis, from 1.5 m outside its centre: it enters the -x face's middle.
        let side = room.trace_all([1.0 - 0.9, 0.5 - 1.2, 0.5], [0.6, 0.8, 0.0]);
        assert!((side.t - 1.0).abs() < 1e-5 && side.face == FACES, "{side:?}");
        assert!((side.uv[0] - 0.5).abs() < 1e-5 && (side.uv[1] - 0.5).abs() < 1e-5);
    }

    #[test]
    fn every_face_is_hit_at_the_point_it_names() {
        let room = room();
        let eye = [-2.0, -1.0, 1.4];
        for face in 0..FACES {
            for (u, v) in [(0.2, 0.3), (0.8, 0.6)] {
                let target = room.world_point(face, u, v);
                let hit = room.trace(eye, [target[0] - eye[0], target[1] - eye[1], target[2] - eye[2]], 0..0);
                assert!(hit.face == face && (hit.t - 1.0).abs() < 1e-5);
                assert!((hit.uv[0] - u).abs() < 1e-5 && (hit.uv[1] - v).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn u_runs_right_and_v_down_for_the_viewer_of_every_upright_face() {
        let room = room();
        for face in [0, 1, 2, 3, FACES, FACES + 1, FACES + 2, FACES + 3] {
            let (a, b) = (room.world_point(face, 0.0, 0.0), room.world_point(face, 1.0, 0.0));
            let n = room.world_normal(face);
            // Right of a viewer who looks against the normal: (-n) x up.
            let right = [-n[1], n[0]];
            assert!((b[0] - a[0]) * right[0] + (b[1] - a[1]) * right[1] > 0.5, "face {face}");
            assert!(room.world_point(face, 0.0, 1.0)[2] < a[2]);
        }
    }

    #[test]
    fn clearance_is_a_signed_distance() {
        let room = room();
        assert!((room.clearance_m([1.0, 0.5, 1.25]) - 0.25).abs() < 1e-6);
        assert!((room.clearance_m([1.0, 0.5, 0.9]) + 0.1).abs() < 1e-6);
        assert!((room.clearance_m([-2.9, 0.0, 1.2]) - 0.1).abs() < 1e-6);
        assert!(
            room.blocked([1.0, -1.8, 0.5], [1.0, 1.9, 0.5])
                && !room.blocked([-1.0, -1.0, 0.5], [-2.0, 1.0, 0.5])
        );
    }
}
