//! Lines that leave the plot, cut at its border: the drawing library would draw them over the labels.

use std::ops::Range;

/// The parts of a line inside the rectangle; a single point inside stays a line of one point.
pub fn clip(line: &[(f64, f64)], x: &Range<f64>, y: &Range<f64>) -> Vec<Vec<(f64, f64)>> {
    let inside = |p: &(f64, f64)| (x.start..=x.end).contains(&p.0) && (y.start..=y.end).contains(&p.1);
    if let [only] = line {
        return if inside(only) { vec![vec![*only]] } else { Vec::new() };
    }
    let mut parts: Vec<Vec<(f64, f64)>> = Vec::new();
    for pair in line.windows(2) {
        let Some((from, to)) = segment(pair[0], pair[1], x, y) else { continue };
        match parts.last_mut() {
            Some(part) if part.last() == Some(&from) => part.push(to),
            _ => parts.push(vec![from, to]),
        }
    }
    parts
}

/// Liang and Barsky: the part of a segment inside the rectangle.
fn segment(a: (f64, f64), b: (f64, f64), x: &Range<f64>, y: &Range<f64>) -> Option<((f64, f64), (f64, f64))> {
    let (dx, dy) = (b.0 - a.0, b.1 - a.1);
    let (mut enter, mut leave) = (0.0f64, 1.0f64);
    for (p, q) in [(-dx, a.0 - x.start), (dx, x.end - a.0), (-dy, a.1 - y.start), (dy, y.end - a.1)] {
        if p == 0.0 {
            if q < 0.0 {
                return None;
            }
        } else if p < 0.0 {
            enter = enter.max(q / p);
        } else {
            leave = leave.min(q / p);
        }
    }
    let at = |t: f64| (a.0 + t * dx, a.1 + t * dy);
    // End points that are inside stay exactly what they were, so that parts join.
    let from = if enter == 0.0 { a } else { at(enter) };
    let to = if leave == 1.0 { b } else { at(leave) };
    (enter <= leave).then_some((from, to))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_end_at_the_border_and_come_back() {
        let line = [(0.5, 0.5), (0.5, 2.5), (0.75, 2.5), (0.75, 0.5), (0.9, 0.5)];
        let parts = clip(&line, &(0.0..1.0), &(0.0..1.0));
        assert_eq!(parts, [vec![(0.5, 0.5), (0.5, 1.0)], vec![(0.75, 1.0), (0.75, 0.5), (0.9, 0.5)]]);
        assert!(clip(&[(2.0, 2.0), (3.0, 3.0)], &(0.0..1.0), &(0.0..1.0)).is_empty());
        assert_eq!(clip(&[(0.1, 0.1)], &(0.0..1.0), &(0.0..1.0)), [vec![(0.1, 0.1)]]);
        assert!(clip(&[(0.1, 7.0)], &(0.0..1.0), &(0.0..1.0)).is_empty());
    }
}
