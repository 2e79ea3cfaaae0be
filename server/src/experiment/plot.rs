//! Plots: lines with points over one axis, as SVG; and meshes, as PNG, since they may have a million triangles.

use super::ExperimentError;
use diamantina_protocol::bintree::Point;
use plotters::prelude::{
    ChartBuilder, Circle, Color, IntoDrawingArea, LineSeries, PathElement, RGBColor, SVGBackend, Text, WHITE,
};

/// Points of a line that are dotted at most.
const DOTTED_MAX: usize = 60;

/// Colours that are told apart on white, by readers who see few colours, too: those of Okabe and Ito (2008) but for the
/// yellow, and a grey.
const COLOURS: [RGBColor; 8] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(86, 180, 233),
    RGBColor(230, 159, 0),
    RGBColor(0, 0, 0),
    RGBColor(140, 140, 140),
];

/// A line of a plot.
#[derive(Debug, Clone)]
pub struct Series {
    /// What it is.
    pub name: String,
    /// x and y, in the order in which they are joined.
    pub points: Vec<[f64; 2]>,
}

/// A plot of several lines. `axes` are the names of x and y, with units. With `is_log` both axes are drawn as
/// base-10 logarithms, and points that have none are left out.
///
/// # Errors
/// When there is nothing to draw.
pub fn lines(
    title: &str,
    axes: [&str; 2],
    is_log: bool,
    series: &[Series],
) -> Result<Vec<u8>, ExperimentError> {
    let scaled = |v: f64| if is_log { v.log10() } else { v };
    let series: Vec<(String, Vec<(f64, f64)>)> = series
        .iter()
        .map(|s| {
            let points = s.points.iter().map(|[x, y]| (scaled(*x), scaled(*y)));
            (s.name.clone(), points.filter(|(x, y)| x.is_finite() && y.is_finite()).collect())
        })
        .collect();
    let all = || series.iter().flat_map(|(_, points)| points);
    let span = |values: Vec<f64>| {
        let low = values.iter().copied().fold(f64::INFINITY, f64::min);
        let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let margin = ((high - low) * 0.04).max(1e-9);
        low - margin..high + margin
    };
    if all().next().is_none() {
        return Err(ExperimentError::Plot(format!("'{title}' has no points")));
    }
    // Of powers of ten and of halves between, three digits.
    let rounded = |v: f64| {
        let last = 10f64.powf(v.floor() - 2.0);
        (10f64.powf(v) / last).round() * last
    };
    let written = |v: f64| format!("{v:.3}").trim_end_matches('0').trim_end_matches('.').to_owned();
    let label = |v: &f64, span: &std::ops::Range<f64>| match is_log {
        false => written(*v),
        // Where there are several, powers of ten alone are told.
        true if span.end - span.start >= 2.0 && (v - v.round()).abs() > 1e-6 => String::new(),
        true => written(rounded(*v)),
    };
    let mut text = String::new();
    let failed = |e: &dyn std::fmt::Display| ExperimentError::Plot(e.to_string());
    {
        let whole = SVGBackend::with_string(&mut text, (1060, 520)).into_drawing_area();
        whole.fill(&WHITE).map_err(|e| failed(&e))?;
        // Names stand beside the plot: within it they would cover data.
        let (area, names) = whole.split_horizontally(860);
        let (x, y) = (span(all().map(|p| p.0).collect()), span(all().map(|p| p.1).collect()));
        let (x_label, y_label) = (|v: &f64| label(v, &x), |v: &f64| label(v, &y));
        let mut chart = ChartBuilder::on(&area)
            .caption(title, ("sans-serif", 20))
            .margin(14)
            .x_label_area_size(46)
            .y_label_area_size(70)
            .build_cartesian_2d(x.clone(), y.clone())
            .map_err(|e| failed(&e))?;
        let mut mesh = chart.configure_mesh();
        mesh.x_desc(axes[0]).y_desc(axes[1]).x_label_formatter(&x_label).y_label_formatter(&y_label);
        mesh.label_style(("sans-serif", 13)).draw().map_err(|e| failed(&e))?;
        for (i, (name, points)) in series.iter().enumerate() {
            let colour = COLOURS[i % COLOURS.len()];
            // Dense lines may lie upon each other: the first are the widest, and show at the edges of the others.
            let over = u32::try_from(series.len() - 1 - i).unwrap_or(0).min(2);
            let width = if points.len() > DOTTED_MAX { 1 + 3 * over } else { 2 };
            let line = LineSeries::new(points.iter().copied(), colour.stroke_width(width));
            chart.draw_series(line).map_err(|e| failed(&e))?;
            let y = 60 + 22 * i32::try_from(i).unwrap_or(i32::MAX / 22 - 60);
            let stroke = PathElement::new([(0, y), (22, y)], colour.stroke_width(3));
            names.draw(&stroke).map_err(|e| failed(&e))?;
            let label = Text::new(name.clone(), (28, y - 7), ("sans-serif", 14));
            names.draw(&label).map_err(|e| failed(&e))?;
            // Of many points dots would hide the line.
            let dotted = points.iter().take(if points.len() > DOTTED_MAX { 0 } else { points.len() });
            let dots = dotted.map(|p| Circle::new(*p, 3, colour.filled()));
            chart.draw_series(dots).map_err(|e| failed(&e))?;
        }
        whole.present().map_err(|e| failed(&e))?;
    }
    Ok(text.into_bytes())
}

/// Pixels along a side of a mesh's picture, about.
const MESH_PIXELS: u32 = 2048;

/// A mesh seen from above: the sides of triangles on a grid of `side` cells, north up, as PNG.
///
/// # Errors
/// Never in practice: it is written to memory.
pub fn mesh(side: u32, triangles: &[[Point; 3]]) -> Result<Vec<u8>, png::EncodingError> {
    let scale = (MESH_PIXELS / side).max(1);
    let size = (side * scale + 1) as usize;
    let mut pixels = vec![255u8; size * size];
    for [a, c, b] in triangles {
        for [from, to] in [[a, c], [c, b], [b, a]] {
            let [from, to] = [from, to].map(|p| [p[0] * scale, (side - p[1]) * scale]);
            let steps = from[0].abs_diff(to[0]).max(from[1].abs_diff(to[1])).max(1);
            for i in 0..=steps {
                // Exact along rows, columns and diagonals, and the nearest pixel but one elsewhere.
                let [x, y] = [0, 1].map(|k| ((from[k] * (steps - i) + to[k] * i) / steps) as usize);
                pixels[y * size + x] = 40;
            }
        }
    }
    super::view::encoded([size; 2], png::ColorType::Grayscale, &pixels)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mesh_of_pixels_has_its_sides_and_nothing_else() {
        let bytes = mesh(1024, &[[[0, 0], [1024, 0], [1024, 1024]]]).unwrap();
        let mut reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info().unwrap();
        let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
        let info = reader.next_frame(&mut pixels).unwrap();
        assert_eq!([info.width, info.height], [2049; 2]);
        let row = |y: usize| &pixels[y * 2049..(y + 1) * 2049];
        // North is up: the southern side is the last row, the eastern the last column; the third is a diagonal.
        assert!(row(2048).iter().all(|p| *p == 40));
        assert!((0..2049).all(|y| row(y)[2048] == 40 && row(y)[2048 - y] == 40));
        assert!((0..2048).all(|y| row(y).iter().filter(|p| **p == 40).count() == 1 + usize::from(y > 0)));
    }
}
