//! Plots as SVG: lines with points over one axis, and meshes.

use super::ExperimentError;
use diamantina_protocol::bintree::Point;
use plotters::prelude::{
    ChartBuilder, Circle, Color, IntoDrawingArea, LineSeries, Palette, Palette99, PathElement, SVGBackend,
    SeriesLabelPosition, WHITE,
};
use std::fmt::Write as _;

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
    let label = |v: &f64| if is_log { format!("{:.3}", 10f64.powf(*v)) } else { format!("{v:.3}") };
    let label = |v: &f64| label(v).trim_end_matches('0').trim_end_matches('.').to_owned();
    let mut text = String::new();
    let failed = |e: &dyn std::fmt::Display| ExperimentError::Plot(e.to_string());
    {
        let area = SVGBackend::with_string(&mut text, (860, 520)).into_drawing_area();
        area.fill(&WHITE).map_err(|e| failed(&e))?;
        let (x, y) = (span(all().map(|p| p.0).collect()), span(all().map(|p| p.1).collect()));
        let mut chart = ChartBuilder::on(&area)
            .caption(title, ("sans-serif", 20))
            .margin(14)
            .x_label_area_size(46)
            .y_label_area_size(70)
            .build_cartesian_2d(x, y)
            .map_err(|e| failed(&e))?;
        let mut mesh = chart.configure_mesh();
        mesh.x_desc(axes[0]).y_desc(axes[1]).x_label_formatter(&label).y_label_formatter(&label);
        mesh.label_style(("sans-serif", 13)).draw().map_err(|e| failed(&e))?;
        for (i, (name, points)) in series.iter().enumerate() {
            let colour = Palette99::pick(i).to_rgba();
            let line = LineSeries::new(points.iter().copied(), colour.stroke_width(2));
            let drawn = chart.draw_series(line).map_err(|e| failed(&e))?;
            drawn
                .label(name)
                .legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], colour.stroke_width(2)));
            let dots = points.iter().map(|p| Circle::new(*p, 3, colour.filled()));
            chart.draw_series(dots).map_err(|e| failed(&e))?;
        }
        let mut legend = chart.configure_series_labels();
        // Errors fall with what was sent.
        legend.position(if is_log {
            SeriesLabelPosition::LowerLeft
        } else {
            SeriesLabelPosition::UpperRight
        });
        legend.background_style(WHITE.mix(0.8)).border_style(Palette99::pick(7).mix(0.3));
        legend.label_font(("sans-serif", 14)).draw().map_err(|e| failed(&e))?;
        area.present().map_err(|e| failed(&e))?;
    }
    Ok(text.into_bytes())
}

/// A mesh seen from above: the sides of triangles on a grid of `side` cells, north up.
#[must_use]
pub fn mesh(side: u32, triangles: &[[Point; 3]]) -> Vec<u8> {
    let mut text = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"-1 -1 {0} {0}\" width=\"900\" height=\"900\">\
         <rect x=\"-1\" y=\"-1\" width=\"{0}\" height=\"{0}\" fill=\"white\"/>\
         <path fill=\"none\" stroke=\"#234\" stroke-width=\"{1}\" stroke-linejoin=\"round\" d=\"",
        side + 2,
        f64::from(side) / 1500.0
    );
    for [a, c, b] in triangles {
        // Writing to a string does not fail.
        let at = |p: &Point| [p[0], side - p[1]];
        let ([ax, ay], [cx, cy], [bx, by]) = (at(a), at(c), at(b));
        let _ = write!(text, "M{ax} {ay}L{cx} {cy}L{bx} {by}Z");
    }
    text.push_str("\"/></svg>\n");
    text.into_bytes()
}
