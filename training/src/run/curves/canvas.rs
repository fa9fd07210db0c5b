//! A picture in memory that the plotting library draws on: smooth lines, and letters of a bitmap font, so that no font
//! has to be on the machine.

use std::convert::Infallible;
use std::io::Cursor;

use embedded_graphics::Drawable;
use embedded_graphics::draw_target::DrawTarget;
use embedded_graphics::geometry::{OriginDimensions, Point, Size};
use embedded_graphics::mono_font::MonoTextStyle;
use embedded_graphics::mono_font::iso_8859_1::FONT_10X20;
use embedded_graphics::pixelcolor::BinaryColor;
use embedded_graphics::text::{Baseline, Text};
use image::{ImageFormat, RgbImage};
use plotters::style::FontTransform;
use plotters_backend::text_anchor::{HPos, VPos};
use plotters_backend::{
    BackendColor, BackendCoord, BackendStyle, BackendTextStyle, DrawingBackend, DrawingErrorKind,
};
use tiny_skia::{
    Color, FillRule, LineCap, LineJoin, Paint, Path, PathBuilder, Pixmap, Rect, Stroke, Transform,
};

/// Pixels per unit of the plot: what suits the letters, which have one size.
const SCALE: u32 = 2;
const CHARACTER_PX: i32 = 10;
const LINE_PX: i32 = 20;

type Drawn = Result<(), DrawingErrorKind<Infallible>>;

/// A white picture, [`SCALE`] times as fine as the plot.
pub(super) struct Picture {
    size: (u32, u32),
    pixels: Pixmap,
}

impl Picture {
    pub(super) fn new(size: (u32, u32)) -> Result<Self, String> {
        let pixels = Pixmap::new(size.0 * SCALE, size.1 * SCALE);
        let mut pixels = pixels.ok_or_else(|| format!("no picture can have the size {size:?}"))?;
        pixels.fill(Color::WHITE);
        Ok(Self { size, pixels })
    }

    pub(super) fn canvas(&mut self) -> Canvas<'_> {
        Canvas { size: self.size, pixels: &mut self.pixels }
    }

    /// The picture as the bytes of a PNG file.
    pub(super) fn to_png(&self) -> Result<Vec<u8>, String> {
        // On white everything is opaque: no alpha to keep or to divide by.
        let rgb = self.pixels.pixels().iter().flat_map(|p| [p.red(), p.green(), p.blue()]).collect();
        let image = RgbImage::from_raw(self.pixels.width(), self.pixels.height(), rgb);
        let image = image.ok_or("the pixels do not fill the picture")?;
        let mut bytes = Cursor::new(Vec::new());
        image.write_to(&mut bytes, ImageFormat::Png).map_err(|error| error.to_string())?;
        Ok(bytes.into_inner())
    }
}

/// Draws on a [`Picture`].
pub(super) struct Canvas<'a> {
    size: (u32, u32),
    pixels: &'a mut Pixmap,
}

impl Canvas<'_> {
    fn stroke(&mut self, path: Option<Path>, style: &impl BackendStyle) {
        let stroke = Stroke {
            width: (style.stroke_width() * SCALE) as f32,
            line_cap: LineCap::Butt,
            line_join: LineJoin::Round,
            ..Stroke::default()
        };
        // No path: nothing to see, as of a line of one point.
        if let Some(path) = path {
            self.pixels.stroke_path(&path, &paint(style.color()), &stroke, Transform::identity(), None);
        }
    }

    fn fill(&mut self, path: Option<Path>, color: BackendColor) {
        if let Some(path) = path {
            self.pixels.fill_path(&path, &paint(color), FillRule::Winding, Transform::identity(), None);
        }
    }
}

impl DrawingBackend for Canvas<'_> {
    type ErrorType = Infallible;

    fn get_size(&self) -> (u32, u32) {
        self.size
    }

    fn ensure_prepared(&mut self) -> Drawn {
        Ok(())
    }

    fn present(&mut self) -> Drawn {
        Ok(())
    }

    fn draw_pixel(&mut self, (x, y): BackendCoord, color: BackendColor) -> Drawn {
        let side = SCALE as f32;
        let square = Rect::from_xywh(x as f32 * side, y as f32 * side, side, side);
        self.fill(square.map(PathBuilder::from_rect), color);
        Ok(())
    }

    fn draw_line<S: BackendStyle>(&mut self, from: BackendCoord, to: BackendCoord, style: &S) -> Drawn {
        self.draw_path([from, to], style)
    }

    fn draw_rect<S: BackendStyle>(
        &mut self,
        (left, top): BackendCoord,
        (right, bottom): BackendCoord,
        style: &S,
        fill: bool,
    ) -> Drawn {
        let corners = [(left, top), (right, top), (right, bottom), (left, bottom)];
        match fill {
            true => self.fill(path(corners, true), style.color()),
            false => self.stroke(path(corners, true), style),
        }
        Ok(())
    }

    fn draw_path<S: BackendStyle, I: IntoIterator<Item = BackendCoord>>(
        &mut self,
        points: I,
        style: &S,
    ) -> Drawn {
        self.stroke(path(points, false), style);
        Ok(())
    }

    fn draw_circle<S: BackendStyle>(
        &mut self,
        center: BackendCoord,
        radius: u32,
        style: &S,
        fill: bool,
    ) -> Drawn {
        let (x, y) = fine(center);
        let circle = PathBuilder::from_circle(x, y, (radius * SCALE) as f32);
        match fill {
            true => self.fill(circle, style.color()),
            false => self.stroke(circle, style),
        }
        Ok(())
    }

    fn fill_polygon<S: BackendStyle, I: IntoIterator<Item = BackendCoord>>(
        &mut self,
        points: I,
        style: &S,
    ) -> Drawn {
        self.fill(path(points, true), style.color());
        Ok(())
    }

    fn draw_text<S: BackendTextStyle>(&mut self, text: &str, style: &S, (x, y): BackendCoord) -> Drawn {
        let width = CHARACTER_PX * text.chars().count() as i32;
        let left = match style.anchor().h_pos {
            HPos::Left => 0,
            HPos::Center => -width / 2,
            HPos::Right => -width,
        };
        let top = match style.anchor().v_pos {
            VPos::Top => 0,
            VPos::Center => -LINE_PX / 2,
            VPos::Bottom => -LINE_PX,
        };
        let letters = MonoTextStyle::new(&FONT_10X20, BinaryColor::On);
        let text = Text::with_baseline(text, Point::new(left, top), letters, Baseline::Top);
        let origin = (x * SCALE as i32, y * SCALE as i32);
        let mut ink =
            Ink { pixels: self.pixels, origin, turn: style.transform(), paint: paint(style.color()) };
        let Ok(_) = text.draw(&mut ink);
        Ok(())
    }
}

/// Takes the pixels of letters to their place.
struct Ink<'a> {
    pixels: &'a mut Pixmap,
    origin: (i32, i32),
    turn: FontTransform,
    paint: Paint<'static>,
}

impl DrawTarget for Ink<'_> {
    type Color = BinaryColor;
    type Error = Infallible;

    fn draw_iter<I: IntoIterator<Item = embedded_graphics::Pixel<BinaryColor>>>(
        &mut self,
        pixels: I,
    ) -> Result<(), Infallible> {
        for embedded_graphics::Pixel(at, color) in pixels {
            let (x, y) = match self.turn {
                FontTransform::None => (at.x, at.y),
                FontTransform::Rotate90 => (-at.y - 1, at.x),
                FontTransform::Rotate180 => (-at.x - 1, -at.y - 1),
                FontTransform::Rotate270 => (at.y, -at.x - 1),
            };
            let (x, y) = ((self.origin.0 + x) as f32, (self.origin.1 + y) as f32);
            if let (BinaryColor::On, Some(square)) = (color, Rect::from_xywh(x, y, 1.0, 1.0)) {
                self.pixels.fill_rect(square, &self.paint, Transform::identity(), None);
            }
        }
        Ok(())
    }
}

impl OriginDimensions for Ink<'_> {
    fn size(&self) -> Size {
        Size::new(self.pixels.width(), self.pixels.height())
    }
}

fn paint(color: BackendColor) -> Paint<'static> {
    let (red, green, blue) = color.rgb;
    let mut paint = Paint::default();
    paint.set_color_rgba8(red, green, blue, (color.alpha.clamp(0.0, 1.0) * 255.0).round() as u8);
    paint
}

fn fine((x, y): BackendCoord) -> (f32, f32) {
    (x as f32 * SCALE as f32, y as f32 * SCALE as f32)
}

fn path(points: impl IntoIterator<Item = BackendCoord>, close: bool) -> Option<Path> {
    let mut builder = PathBuilder::new();
    for (n, (x, y)) in points.into_iter().map(fine).enumerate() {
        match n {
            0 => builder.move_to(x, y),
            _ => builder.line_to(x, y),
        }
    }
    if close {
        builder.close();
    }
    builder.finish()
}

#[cfg(test)]
mod tests {
    use plotters::prelude::*;

    use super::{Canvas, FontTransform, Picture};

    /// Where the picture is not white: left, top, right and bottom, in fine pixels.
    fn inked(draw: impl FnOnce(&DrawingArea<Canvas<'_>, plotters::coord::Shift>)) -> Option<[u32; 4]> {
        let mut picture = Picture::new((100, 60)).unwrap();
        draw(&picture.canvas().into_drawing_area());
        let image = image::load_from_memory(&picture.to_png().unwrap()).unwrap().into_rgb8();
        let dark = image.enumerate_pixels().filter(|(_, _, pixel)| pixel.0 != [255; 3]);
        dark.map(|(x, y, _)| [x, y, x + 1, y + 1])
            .reduce(|a, b| [a[0].min(b[0]), a[1].min(b[1]), a[2].max(b[2]), a[3].max(b[3])])
    }

    fn text_in(turn: FontTransform) -> [u32; 4] {
        inked(|area| {
            let style = ("sans-serif", 14).into_font().transform(turn).color(&BLACK);
            area.draw(&Text::new("0°", (50, 30), style)).unwrap();
        })
        .unwrap()
    }

    #[test]
    fn letters_need_no_font_of_the_machine_and_turn_about_their_anchor() {
        let inside = |found: [u32; 4], [left, top, right, bottom]: [u32; 4]| {
            found[0] >= left && found[1] >= top && found[2] <= right && found[3] <= bottom
        };
        let found = text_in(FontTransform::None);
        assert!(inside(found, [100, 60, 120, 80]), "{found:?}");
        let found = text_in(FontTransform::Rotate270);
        assert!(inside(found, [100, 40, 120, 60]), "{found:?}");
        let found = text_in(FontTransform::Rotate90);
        assert!(inside(found, [80, 60, 100, 80]), "{found:?}");
        let found = text_in(FontTransform::Rotate180);
        assert!(inside(found, [80, 40, 100, 60]), "{found:?}");
    }

    #[test]
    fn shapes_are_where_they_belong() {
        let found = inked(|area| {
            area.draw(&Rectangle::new([(10, 20), (30, 40)], RED.filled())).unwrap();
        });
        assert_eq!(found, Some([20, 40, 60, 80]));
        let found = inked(|area| {
            area.draw(&PathElement::new([(10, 20), (30, 20)], BLUE.stroke_width(2))).unwrap();
        });
        assert_eq!(found, Some([20, 38, 60, 42]));
        let found = inked(|area| area.draw(&Circle::new((50, 30), 5, GREEN.filled())).unwrap());
        assert_eq!(found, Some([90, 50, 110, 70]));
        assert_eq!(inked(|_| {}), None);
        // Far outside, and nothing at all.
        let found = inked(|area| {
            area.draw(&PathElement::new([(-1_000_000, 5), (-900_000, 5)], BLACK)).unwrap();
            area.draw(&PathElement::new(Vec::new(), BLACK)).unwrap();
        });
        assert_eq!(found, None);
    }
}
