//! Draws the panels, one below the other, on any kind of picture.

use plotters::coord::Shift;
use plotters::coord::ranged1d::{AsRangedCoord, ValueFormatter};
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::content::{Content, Panel, Stage};
use super::series::Point;
use crate::report::svg::{FONT, FONT_PX, WIDTH, colour_of, tick};

const INK: RGBColor = RGBColor(0x1d, 0x24, 0x30);
const GRID: RGBColor = RGBColor(0xd5, 0xda, 0xe1);
const ALARM: RGBColor = RGBColor(0xc0, 0x1c, 0x28);

const MARGIN_PX: u32 = 10;
const STAGES_PX: u32 = 22;
const LEGEND_PX: u32 = 22;
const PLOT_PX: u32 = 168;
const STEPS_PX: u32 = 42;
const VALUES_PX: u32 = 74;
const RIGHT_PX: u32 = 18;
/// Width of a letter, rather more than less.
const LETTER_PX: i32 = 6;

type Failed<DB> = DrawingAreaErrorKind<<DB as DrawingBackend>::ErrorType>;

/// Height of the picture.
pub(super) fn height(content: &Content) -> u32 {
    let panels = content.panels.len().max(1) as u32;
    2 * MARGIN_PX + STAGES_PX + panels * (LEGEND_PX + PLOT_PX) + STEPS_PX
}

pub(super) fn draw<DB: DrawingBackend>(
    area: &DrawingArea<DB, Shift>,
    content: &Content,
) -> Result<(), Failed<DB>> {
    area.fill(&WHITE)?;
    let area = area.margin(MARGIN_PX, MARGIN_PX, MARGIN_PX, 0);
    let (stages, mut rest) = area.split_vertically(STAGES_PX);
    if content.panels.is_empty() {
        let at = (WIDTH as i32 / 2, (LEGEND_PX + PLOT_PX) as i32 / 2);
        return rest.draw(&Text::new("nothing is logged yet", at, centred()));
    }
    name_stages(&stages, content)?;
    for (n, panel) in content.panels.iter().enumerate() {
        let is_last = n + 1 == content.panels.len();
        let (top, below) = rest.split_vertically(LEGEND_PX);
        let (plot, below) = below.split_vertically(PLOT_PX + if is_last { STEPS_PX } else { 0 });
        rest = below;
        legend(&top, panel)?;
        let range = panel.axis.range.clone();
        match panel.axis.is_log {
            true => draw_panel(&plot, content, panel, range.log_scale(), is_last)?,
            false => draw_panel(&plot, content, panel, range, is_last)?,
        }
    }
    area.present()
}

fn draw_panel<DB, Y>(
    area: &DrawingArea<DB, Shift>,
    content: &Content,
    panel: &Panel,
    y: Y,
    is_last: bool,
) -> Result<(), Failed<DB>>
where
    DB: DrawingBackend,
    Y: AsRangedCoord<Value = f64>,
    Y::CoordDescType: ValueFormatter<f64>,
{
    let mut chart = ChartBuilder::on(area)
        .margin_right(RIGHT_PX)
        .x_label_area_size(if is_last { STEPS_PX } else { 0 })
        .y_label_area_size(VALUES_PX)
        .build_cartesian_2d(content.steps.clone(), y)?;
    let mut mesh = chart.configure_mesh();
    mesh.light_line_style(TRANSPARENT)
        .bold_line_style(GRID)
        .axis_style(INK)
        .x_labels(8)
        .y_labels(5)
        .x_label_formatter(&tick)
        .y_label_formatter(&value)
        .label_style((FONT, FONT_PX).into_font().color(&INK))
        .y_desc(panel.label);
    if is_last {
        mesh.x_desc("step");
    }
    mesh.draw()?;

    let (low, high) = (panel.axis.range.start, panel.axis.range.end);
    for (n, stage) in content.stages.iter().enumerate() {
        let (from, to) = (stage.steps.start, stage.steps.end);
        if n % 2 == 1 {
            chart.draw_series([Rectangle::new([(from, low), (to, high)], INK.mix(0.06).filled())])?;
        }
        if n > 0 {
            let line = [(from, low), (from, high)];
            chart.draw_series(DashedLineSeries::new(line, 2, 5, INK.mix(0.5).into()))?;
        }
    }
    for step in &panel.not_finite {
        chart.draw_series([PathElement::new([(*step, low), (*step, high)], ALARM.mix(0.35))])?;
        chart.draw_series([Cross::new((*step, high), 4, ALARM.stroke_width(2))])?;
    }
    for (n, line) in panel.lines.iter().enumerate() {
        let colour = colour_of(n).0;
        let bound = |piece: &Vec<Point>| -> Vec<Point> {
            piece.iter().map(|(step, value)| (*step, panel.axis.bound(*value))).collect()
        };
        let faint = !line.smooth.is_empty();
        for piece in line.raw.iter().map(bound) {
            let style = if faint { colour.mix(0.3).stroke_width(1) } else { colour.stroke_width(2) };
            if line.held_out || piece.len() == 1 {
                chart.draw_series(piece.iter().map(|point| Circle::new(*point, 3, colour.filled())))?;
            }
            chart.draw_series(LineSeries::new(piece, style))?;
        }
        for piece in line.smooth.iter().map(bound) {
            chart.draw_series(LineSeries::new(piece, colour.stroke_width(2)))?;
        }
    }
    Ok(())
}

/// The names above their stretches, as far as there is room.
fn name_stages<DB: DrawingBackend>(
    area: &DrawingArea<DB, Shift>,
    content: &Content,
) -> Result<(), Failed<DB>> {
    let width = (WIDTH - MARGIN_PX - VALUES_PX - RIGHT_PX) as f64;
    let pixel = |step: f64| {
        let share = (step - content.steps.start) / (content.steps.end - content.steps.start);
        (f64::from(VALUES_PX) + share * width) as i32
    };
    for Stage { name, steps } in &content.stages {
        let (from, to) = (pixel(steps.start), pixel(steps.end));
        if name.chars().count() as i32 * LETTER_PX <= to - from {
            area.draw(&Text::new(name.clone(), ((from + to) / 2, STAGES_PX as i32 / 2), centred()))?;
        }
    }
    Ok(())
}

fn legend<DB: DrawingBackend>(area: &DrawingArea<DB, Shift>, panel: &Panel) -> Result<(), Failed<DB>> {
    let (mut x, y) = (VALUES_PX as i32, LEGEND_PX as i32 / 2);
    let mut entries: Vec<_> =
        panel.lines.iter().enumerate().map(|(n, line)| (line.label.as_str(), colour_of(n).0)).collect();
    if !panel.not_finite.is_empty() {
        entries.push(("not finite", ALARM));
    }
    for (label, colour) in entries {
        area.draw(&PathElement::new([(x, y), (x + 20, y)], colour.stroke_width(3)))?;
        let style = (FONT, FONT_PX).into_font().color(&INK).pos(Pos::new(HPos::Left, VPos::Center));
        area.draw(&Text::new(label.to_owned(), (x + 26, y), style))?;
        x += 26 + label.chars().count() as i32 * LETTER_PX + 20;
    }
    Ok(())
}

fn centred() -> TextStyle<'static> {
    (FONT, FONT_PX).into_font().color(&INK).pos(Pos::new(HPos::Center, VPos::Center))
}

/// Label of a value, as short as three digits allow.
fn value(value: &f64) -> String {
    let magnitude = value.abs();
    if *value != 0.0 && !(1e-3..1e5).contains(&magnitude) {
        return format!("{value:.0e}");
    }
    tick(value)
}
