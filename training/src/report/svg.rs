//! Common ground of all plots: size, colours, legends, and what is done to the SVG text.
//!
//! Plots are drawn in stand-in colours for ink, grid and paper. A stand-alone file gets fixed ones on white paper; inside
//! the page they become the page's own, so that plots follow its light or dark scheme.

use plotters::coord::Shift;
use plotters::prelude::*;

use super::ReportError;

/// A drawing surface.
pub type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;
/// What drawing can fail with.
pub type DrawError = DrawingAreaErrorKind<std::io::Error>;

/// Width of every plot in pixels.
pub const WIDTH: u32 = 860;
/// Stand-in for the colour of text and axes.
pub const INK: RGBColor = RGBColor(1, 2, 3);
/// Stand-in for the colour of grid lines.
pub const GRID: RGBColor = RGBColor(4, 5, 6);
/// Font of labels.
pub const FONT: &str = "sans-serif";
/// Size of labels in pixels.
pub const FONT_PX: i32 = 14;
/// Width that a character of a label takes on the average, in pixels.
const CHARACTER_PX: i32 = 7;

const INK_TEXT: &str = "#010203";
const GRID_TEXT: &str = "#040506";

/// Colours that can be told apart by the colour-blind and read on white and on black (after Okabe and Ito).
const COLOURS: [(RGBColor, &str); 14] = [
    (RGBColor(0x2f, 0x7f, 0xd1), "#2f7fd1"),
    (RGBColor(0xd9, 0x5f, 0x0e), "#d95f0e"),
    (RGBColor(0x12, 0x9e, 0x76), "#129e76"),
    (RGBColor(0xc0, 0x5c, 0xa5), "#c05ca5"),
    (RGBColor(0xb8, 0x8a, 0x00), "#b88a00"),
    (RGBColor(0x3b, 0xa3, 0xc7), "#3ba3c7"),
    (RGBColor(0xd1, 0x45, 0x4b), "#d1454b"),
    (RGBColor(0x7d, 0x6b, 0xd6), "#7d6bd6"),
    (RGBColor(0x6f, 0x93, 0x2c), "#6f932c"),
    (RGBColor(0x9a, 0x70, 0x4f), "#9a704f"),
    (RGBColor(0x6b, 0x78, 0x88), "#6b7888"),
    (RGBColor(0xa8, 0x41, 0x7a), "#a8417a"),
    (RGBColor(0x4f, 0x8f, 0x8b), "#4f8f8b"),
    (RGBColor(0xe0, 0x7f, 0x5b), "#e07f5b"),
];

/// Colour of the n-th system, for drawing and as text.
pub fn colour_of(n: usize) -> (RGBColor, &'static str) {
    COLOURS[n % COLOURS.len()]
}

/// Draws a plot of `height` pixels; the result is to go through [`standalone`] or [`inline`].
pub fn draw(
    name: &str,
    height: u32,
    content: impl FnOnce(&Area<'_>) -> Result<(), DrawError>,
) -> Result<String, ReportError> {
    let mut text = String::new();
    {
        let area = SVGBackend::with_string(&mut text, (WIDTH, height)).into_drawing_area();
        let failed = |error: DrawError| ReportError::Plot { name: name.into(), reason: error.to_string() };
        content(&area).map_err(failed)?;
        area.present().map_err(failed)?;
    }
    Ok(text)
}

/// A file of its own: black on white.
pub fn standalone(svg: &str) -> String {
    let svg = svg.replace(INK_TEXT, "#1d2430").replace(GRID_TEXT, "#d5dae1");
    let paper = "<rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>";
    match svg.find('>') {
        Some(end) => format!("{}{paper}{}", &svg[..=end], &svg[end + 1..]),
        None => svg,
    }
}

/// A part of the page: as wide as its column, in the page's colours, described for those who cannot see it.
pub fn inline(svg: &str, title: &str) -> String {
    let svg = svg.replace(INK_TEXT, "var(--ink)").replace(GRID_TEXT, "var(--grid)");
    let size = format!("width=\"{WIDTH}\" ");
    let svg = svg.replacen(&size, "", 1);
    // The height follows from the view box.
    let svg = match (svg.find("height=\""), svg.find("viewBox")) {
        (Some(height), Some(view)) if height < view => format!("{}{}", &svg[..height], &svg[view..]),
        _ => svg,
    };
    svg.replacen("<svg ", &format!("<svg role=\"img\" aria-label=\"{}\" ", escape(title)), 1)
}

/// Label of a tick: at most three decimals, none that are zero, no negative zero.
pub fn tick(value: &f64) -> String {
    let rounded = (value * 1000.0).round() / 1000.0;
    // Adding zero turns -0 into 0.
    format!("{}", rounded + 0.0)
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('"', "&quot;")
}

/// An entry of a legend.
#[derive(Debug, Clone)]
pub struct Entry {
    pub label: String,
    pub colour: RGBColor,
    pub width: u32,
}

/// Height in pixels that [`legend`] needs.
pub fn legend_height(entries: &[Entry]) -> u32 {
    let rows = layout(entries).last().map_or(0, |(_, y)| y / ROW_PX + 1);
    (rows * ROW_PX + 8) as u32
}

/// Draws a legend along the top, where it covers no data, and gives back the rest.
pub fn legend<'a>(area: &Area<'a>, entries: &[Entry]) -> Result<Area<'a>, DrawError> {
    let (top, rest) = area.split_vertically(legend_height(entries));
    for (entry, (x, y)) in entries.iter().zip(layout(entries)) {
        let middle = y + ROW_PX / 2 + 4;
        let line = [(x, middle), (x + 22, middle)];
        top.draw(&PathElement::new(line, entry.colour.stroke_width(entry.width + 1)))?;
        let style = (FONT, FONT_PX).into_font().color(&INK);
        top.draw(&Text::new(entry.label.clone(), (x + 28, middle - FONT_PX / 2), style))?;
    }
    Ok(rest)
}

const ROW_PX: i32 = 20;

fn layout(entries: &[Entry]) -> Vec<(i32, i32)> {
    let (mut x, mut y) = (60, 0);
    let place = |entry: &Entry| {
        let width = 28 + entry.label.chars().count() as i32 * CHARACTER_PX + 18;
        if x > 60 && x + width > WIDTH as i32 {
            (x, y) = (60, y + ROW_PX);
        }
        let at = (x, y);
        x += width;
        at
    };
    entries.iter().map(place).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn plots_take_the_colours_of_where_they_are() {
        let svg = draw("test", 50, |area| {
            area.draw(&PathElement::new([(0, 0), (10, 10)], INK))?;
            area.draw(&PathElement::new([(0, 9), (10, 10)], GRID))
        })
        .unwrap();
        let page = inline(&svg, "a < b");
        assert!(
            page.contains("var(--ink)") && page.contains("var(--grid)") && page.contains("a &lt; b"),
            "{page}"
        );
        assert!(!page.contains("width=\"860\"") && page.contains("viewBox=\"0 0 860 50\""), "{page}");
        let file = standalone(&svg);
        assert!(file.contains("#1d2430") && !file.contains("var(") && file.contains("#ffffff"), "{file}");
    }

    #[test]
    fn ticks_are_short() {
        assert_eq!(
            [0.1 + 0.2, -1e-17, 5.0, -0.25, 1000.0].map(|v| tick(&v)),
            ["0.3", "0", "5", "-0.25", "1000"]
        );
    }

    #[test]
    fn long_legends_wrap() {
        let entry = |label: &str| Entry { label: label.into(), colour: INK, width: 1 };
        let short = [entry("truth"), entry("odometry")];
        assert_eq!(legend_height(&short), 28);
        let long: Vec<Entry> = (0..6).map(|_| entry("retrieval, CNN1 of a model with a name")).collect();
        assert!(legend_height(&long) >= 68);
        assert!(layout(&long).iter().all(|(x, _)| *x < WIDTH as i32 - 200));
    }
}
