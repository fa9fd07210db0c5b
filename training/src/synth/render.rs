//! The camera: one exact ray through every pixel's centre, filtered textures, smoothed silhouettes.

use grnet_frame::{Camera, Distortion};
use nalgebra::Isometry3;

use super::SynthError;
use super::geometry::Hit;
use super::numeric::{Vec3, along, cross, dot, sub};
use super::scene::Scene;

/// Side of the square tiles that share a list of furniture within sight, in pixels.
const TILE_PX: usize = 16;

/// What a camera sees, before its sensor.
#[derive(Debug, Clone)]
pub struct RenderTarget {
    width: usize,
    height: usize,
    edge_samples: usize,
    /// Linear light (r, g, b) of every pixel, row by row; 1 is a white wall in mean light.
    pub radiance: Vec<Vec3>,
    /// Depth along the optical axis at every pixel's centre, in metres.
    pub depth_m: Vec<f32>,
    /// Face that every pixel's centre shows: equal numbers are one flat rectangle of the room.
    pub face: Vec<u32>,
}

impl RenderTarget {
    /// An empty target; pixels on silhouettes take the mean of `edge_samples` rays (1: no smoothing).
    pub fn new(edge_samples: usize) -> Self {
        Self {
            width: 0,
            height: 0,
            edge_samples: edge_samples.max(1),
            radiance: Vec::new(),
            depth_m: Vec::new(),
            face: Vec::new(),
        }
    }

    /// Width and height of the last image in pixels.
    pub fn size_px(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    fn resize(&mut self, (width, height): (u32, u32)) {
        (self.width, self.height) = (width as usize, height as usize);
        let pixels = self.width * self.height;
        self.radiance.resize(pixels, [0.0; 3]);
        self.depth_m.resize(pixels, 0.0);
        self.face.resize(pixels, 0);
    }
}

/// A camera at a pose, in single precision: the ray through pixel (x, y) is
/// `origin + forward + right * (x - cx) / fx + down * (y - cy) / fy`, so its parameter is the depth.
#[derive(Debug, Clone, Copy)]
struct Eye {
    origin: Vec3,
    forward: Vec3,
    /// Change of the ray's direction from a pixel to its right neighbour.
    step_x: Vec3,
    /// Change of the ray's direction from a pixel to its lower neighbour.
    step_y: Vec3,
    centre: [f32; 2],
}

impl Eye {
    fn new(world_from_camera: &Isometry3<f64>, camera: &Camera) -> Self {
        let rotation = world_from_camera.rotation.to_rotation_matrix();
        let column = |k: usize, scale: f64| [0, 1, 2].map(|i| (rotation[(i, k)] / scale) as f32);
        let (fx, fy) = camera.focal_px();
        let (cx, cy) = camera.centre_px();
        Self {
            origin: [0, 1, 2].map(|i| world_from_camera.translation.vector[i] as f32),
            forward: column(2, 1.0),
            step_x: column(0, fx),
            step_y: column(1, fy),
            centre: [cx as f32, cy as f32],
        }
    }

    fn ray(&self, x: f32, y: f32) -> Vec3 {
        along(along(self.forward, self.step_x, x - self.centre[0]), self.step_y, y - self.centre[1])
    }
}

impl Scene {
    /// Renders the view of a camera at `world_from_camera` (x right, y down, z forward) into `target`, which
    /// takes the camera's size. Runs on the calling thread; the result depends on nothing but the arguments.
    ///
    /// # Errors
    /// [`SynthError::Distorted`] for a camera with lens distortion.
    pub fn render(
        &self,
        world_from_camera: &Isometry3<f64>,
        camera: &Camera,
        target: &mut RenderTarget,
    ) -> Result<(), SynthError> {
        let eye = Eye::new(world_from_camera, camera);
        self.render_eyes(&|_| eye, TILE_PX, camera, target)
    }

    /// Like [`Scene::render`] with a rolling shutter: row `y` is seen from `world_from_camera(y)`.
    ///
    /// # Errors
    /// [`SynthError::Distorted`] for a camera with lens distortion.
    pub fn render_rolling(
        &self,
        world_from_camera: &dyn Fn(usize) -> Isometry3<f64>,
        camera: &Camera,
        target: &mut RenderTarget,
    ) -> Result<(), SynthError> {
        self.render_eyes(&|row| Eye::new(&world_from_camera(row), camera), 1, camera, target)
    }

    fn render_eyes(
        &self,
        eye_of_row: &dyn Fn(usize) -> Eye,
        tile_rows: usize,
        camera: &Camera,
        target: &mut RenderTarget,
    ) -> Result<(), SynthError> {
        if camera.distortion() != Distortion::None {
            return Err(SynthError::Distorted);
        }
        target.resize(camera.size_px());
        let (width, height) = (target.width, target.height);
        let mut tiles = Vec::new();
        for top in (0..height).step_by(tile_rows) {
            let eye = eye_of_row(top);
            for left in (0..width).step_by(TILE_PX) {
                let (right, bottom) = ((left + TILE_PX).min(width), (top + tile_rows).min(height));
                let groups = self.groups_in_sight(&eye, [left, top, right, bottom]);
                for y in top..bottom {
                    for x in left..right {
                        let (hit, radiance) = self.look(&eye, x as f32, y as f32, &groups);
                        let pixel = y * width + x;
                        target.radiance[pixel] = radiance;
                        target.depth_m[pixel] = hit.t;
                        target.face[pixel] = hit.face as u32;
                    }
                }
                tiles.push((eye, [left, top, right, bottom], groups));
            }
        }
        if target.edge_samples > 1 {
            for (eye, area, groups) in &tiles {
                self.smooth_edges(eye, *area, groups, target);
            }
        }
        Ok(())
    }

    fn smooth_edges(&self, eye: &Eye, area: [usize; 4], groups: &[usize], target: &mut RenderTarget) {
        let [left, top, right, bottom] = area;
        let (width, height, samples) = (target.width, target.height, target.edge_samples);
        for y in top..bottom {
            for x in left..right {
                let pixel = y * width + x;
                let own = target.face[pixel];
                let differs = |other: usize| target.face[other] != own;
                let edge = (x > 0 && differs(pixel - 1))
                    || (x + 1 < width && differs(pixel + 1))
                    || (y > 0 && differs(pixel - width))
                    || (y + 1 < height && differs(pixel + width));
                if !edge {
                    continue;
                }
                let mut sum = [0.0; 3];
                for k in 0..samples {
                    // A rank-1 lattice: rows evenly spaced, columns spread by the golden ratio.
                    let dy = (k as f32 + 0.5) / samples as f32 - 0.5;
                    let column = k as f32 * 0.618_034 + 0.25;
                    let dx = column - column.floor() - 0.5;
                    let (_, c) = self.look(eye, x as f32 + dx, y as f32 + dy, groups);
                    sum = along(sum, c, 1.0 / samples as f32);
                }
                target.radiance[pixel] = sum;
            }
        }
    }

    fn look(&self, eye: &Eye, x: f32, y: f32, groups: &[usize]) -> (Hit, Vec3) {
        let ray = eye.ray(x, y);
        let hit = self.geometry().trace(eye.origin, ray, groups.iter().copied());
        let rect = &self.geometry().rects[hit.face];
        let local = |d: Vec3| rect.group.map_or(d, |group| self.geometry().groups[group].turned_in(d));
        let (d, step_x, step_y) = (local(ray), local(eye.step_x), local(eye.step_y));
        // Where the neighbouring pixels' rays meet this plane: t (s - d (n.s) / (n.d)).
        let axis = rect.axes[0];
        let on_plane = |s: Vec3| rect.uv_step(along(s, d, -s[axis] / d[axis]).map(|c| c * hit.t));
        let radiance =
            self.texture(hit.face).sample(hit.uv[0], hit.uv[1], on_plane(step_x), on_plane(step_y));
        (hit, radiance)
    }

    /// Groups whose sphere meets the pyramid of rays through the tile (with a margin of a pixel), nearest first.
    fn groups_in_sight(&self, eye: &Eye, [left, top, right, bottom]: [usize; 4]) -> Vec<usize> {
        let (l, t, r, b) = (left as f32 - 1.0, top as f32 - 1.0, right as f32, bottom as f32);
        let corners = [eye.ray(l, t), eye.ray(r, t), eye.ray(r, b), eye.ray(l, b)];
        let middle = eye.ray((l + r) / 2.0, (t + b) / 2.0);
        let planes = [0, 1, 2, 3].map(|k| {
            let n = cross(corners[k], corners[(k + 1) % 4]);
            let scale = 1.0 / dot(n, n).sqrt();
            let inward = if dot(n, middle) > 0.0 { scale } else { -scale };
            n.map(|c| c * inward)
        });
        let mut seen: Vec<(f32, usize)> = Vec::new();
        for (index, group) in self.geometry().groups.iter().enumerate() {
            let to = sub(group.sphere_centre, eye.origin);
            let reach = -group.sphere_radius;
            if planes.iter().all(|n| dot(*n, to) > reach) && dot(eye.forward, to) > reach {
                seen.push((dot(to, to).sqrt() + reach, index));
            }
        }
        seen.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        seen.into_iter().map(|(_, index)| index).collect()
    }
}
