//! What commands print of their results, for people.

use crate::layer_args::word;
use diamantina_protocol::message::{Layer, Scene};
use diamantina_protocol::series::Series;
use diamantina_protocol::texture::Texture;
use diamantina_server::experiment;
use diamantina_server::hierarchy::{Estimate, Estimates, LayerReport, Report};
use diamantina_server::inspect::{Inspection, TinInspection};
use diamantina_server::zone;
use std::io::Write;
use std::path::Path;

/// Whether a layer is a step of a series, but not its first: what is told of that holds, more or less, for all.
fn is_later_step(all: &[Series], layer: &str) -> bool {
    all.iter().any(|series| series.layers.iter().skip(1).any(|step| step == layer))
}

/// A series in a line, with what its steps take in all.
fn series(out: &mut impl Write, series: &Series, bytes: u64) -> std::io::Result<()> {
    writeln!(
        out,
        "series {}: {} step{} of {} s, {bytes} bytes in all; --json tells of each",
        series.name,
        series.layers.len(),
        if series.layers.len() == 1 { "" } else { "s" },
        series.step_seconds
    )
}

fn all_series(out: &mut impl Write, scene: &Scene) -> std::io::Result<()> {
    for one in &scene.series {
        let steps = scene.layers.iter().filter(|layer| one.layers.contains(&layer.name));
        series(out, one, steps.map(|layer| layer.bytes).sum())?;
    }
    Ok(())
}

pub(super) fn estimates(
    out: &mut impl Write,
    store: &Path,
    e: &Estimates,
    all: &[Series],
) -> std::io::Result<()> {
    writeln!(
        out,
        "{}: estimated from {} of {} samples; nothing was written",
        store.display(),
        e.all.sampled,
        e.all.samples
    )?;
    for layer in e.layers.iter().filter(|layer| e.layers.len() > 1 && !is_later_step(all, &layer.name)) {
        writeln!(out, "layer {}: {} samples", layer.name, layer.estimate.samples)?;
        estimate(out, &layer.estimate)?;
    }
    for one in all {
        let steps = e.layers.iter().filter(|layer| one.layers.contains(&layer.name));
        series(out, one, steps.map(|step| step.estimate.point_bytes + step.estimate.tin_bytes).sum())?;
    }
    if e.layers.len() > 1 {
        writeln!(out, "all layers, one after the other:")?;
    }
    estimate(out, &e.all)
}

fn estimate(out: &mut impl Write, e: &Estimate) -> std::io::Result<()> {
    writeln!(out, "  {:.1} % nodata", 100.0 * (1.0 - e.valid_samples as f64 / e.samples as f64))?;
    if e.diamonds > 0 || e.triangles == 0 {
        writeln!(
            out,
            "  about {} diamonds, {} bytes of points ({:.2} bits a sample)",
            e.diamonds, e.point_bytes, e.bits_per_sample
        )?;
    }
    if e.triangles > 0 {
        writeln!(out, "  about {} triangles of all levels, {} bytes", e.triangles, e.tin_bytes)?;
    }
    let mebibytes = |bytes: u64| bytes as f64 / f64::from(1 << 20);
    writeln!(
        out,
        "  about {:.1} s with {} threads, at most {:.0} MiB of memory, {:.0} MiB of disk while at work",
        e.seconds,
        rayon::current_num_threads(),
        mebibytes(e.memory_bytes),
        mebibytes(e.disk_bytes)
    )
}

pub(super) fn report(out: &mut impl Write, store: &Path, report: &Report) -> std::io::Result<()> {
    writeln!(out, "{}: scene '{}', version {}", store.display(), report.scene.name, report.scene.version)?;
    for (layer, found) in report.scene.layers.iter().zip(&report.layers) {
        if is_later_step(&report.scene.series, &layer.name) {
            continue;
        }
        if report.layers.len() > 1 {
            writeln!(out, "layer {}: {}", layer.name, word(layer.kind))?;
        }
        built(out, layer, found)?;
    }
    all_series(out, &report.scene)?;
    for texture in &report.scene.textures {
        self::texture(out, texture)?;
    }
    writeln!(out, "  {:.1} s, {:.2} Msamples/s", report.seconds, report.msamples_per_second)?;
    writeln!(out, "Next: diamantina-server serve {}", store.display())
}

/// What is known of a texture before it is built.
pub(super) fn planned_texture(out: &mut impl Write, texture: &Texture) -> std::io::Result<()> {
    writeln!(
        out,
        "texture {}: {} x {} texels in {} levels, at most {} tiles, {:.0} MiB of disk while at work; its bytes are not estimated",
        texture.name,
        texture.size[0],
        texture.size[1],
        texture.levels(),
        texture.grid_tiles(),
        texture.size.map(f64::from).iter().product::<f64>() * 4.0 / 3.0 / f64::from(1 << 20)
    )
}

fn texture(out: &mut impl Write, texture: &Texture) -> std::io::Result<()> {
    writeln!(
        out,
        "texture {}: {} x {} texels of {:.3} x {:.3} m in {} levels, {} tiles of {} bytes, quality {}{}",
        texture.name,
        texture.size[0],
        texture.size[1],
        texture.texel[0],
        texture.texel[1],
        texture.levels(),
        texture.tiles,
        texture.bytes,
        texture.quality,
        if texture.resampled { ", resampled to the frame" } else { "" }
    )
}

fn built(out: &mut impl Write, layer: &Layer, report: &LayerReport) -> std::io::Result<()> {
    writeln!(
        out,
        "  {} x {} samples of {:.3} x {:.3} m, heights {:.3} to {:.3} m, {:.1} % nodata",
        layer.samples[0],
        layer.samples[1],
        layer.cell[0],
        layer.cell[1],
        layer.heights[0],
        layer.heights[1],
        100.0 * (1.0 - layer.valid_samples as f64 / report.samples as f64),
    )?;
    if report.diamonds > 0 || layer.tin.is_none() {
        writeln!(
            out,
            "  {} diamonds, {} bytes of points ({:.3} bits a sample), {} bytes of index, finest error {} m",
            report.diamonds,
            report.point_bytes,
            report.bits_per_sample,
            report.index_bytes,
            layer.finest_error,
        )?;
    }
    if let Some(tin) = &layer.tin {
        writeln!(
            out,
            "  {} triangles, {} bytes with their index, finest error {} m",
            tin.triangles, tin.bytes, tin.finest_error
        )?;
    }
    Ok(())
}

pub(super) fn inspection(out: &mut impl Write, i: &Inspection) -> std::io::Result<()> {
    let crs = i.scene.frame.crs.as_ref().map_or("unknown", |c| &c.name);
    writeln!(out, "scene {}  version {}  CRS {crs}", i.scene.name, i.scene.version)?;
    for (layer, about) in i.layers.iter().zip(&i.scene.layers) {
        if is_later_step(&i.scene.series, &layer.name) {
            continue;
        }
        let [columns, rows] = about.forest.roots();
        writeln!(
            out,
            "layer {}: {}, {} x {} samples of {:.3} x {:.3} m, {columns} x {rows} roots, quantum {} m, errors {}",
            layer.name,
            word(about.kind),
            about.samples[0],
            about.samples[1],
            about.cell[0],
            about.cell[1],
            about.quantum,
            layer.errors
        )?;
        if let Some(tin) = &layer.tin {
            triangles(out, tin, about)?;
        }
        if !about.encodings.iter().any(|e| e == "points") {
            continue;
        }
        writeln!(out, "  level  diamonds        bytes     step [m]   error min [m]   error max [m]")?;
        for l in &layer.levels {
            writeln!(
                out,
                "  {:>5} {:>9} {:>12} {:>12} {:>15} {:>15}",
                l.level, l.diamonds, l.bytes, l.step, l.error_min, l.error_max
            )?;
        }
        writeln!(out, "  finest error {} m (asked: {} m)", layer.finest_error, about.max_error)?;
        writeln!(
            out,
            "  {} bytes of points, {:.3} bits a sample; {} bytes of index",
            layer.point_bytes, layer.bits_per_sample, layer.index_bytes
        )?;
        if let (Some(real), Some(fictitious)) = (layer.real_points, layer.fictitious_points) {
            writeln!(out, "  {real} real points, {fictitious} fictitious")?;
        }
    }
    all_series(out, &i.scene)?;
    for texture in &i.scene.textures {
        self::texture(out, texture)?;
    }
    for zone in &i.scene.zones {
        let ceilings: Vec<String> = zone.parts.iter().map(|part| format!("{:.3}", part.ceiling)).collect();
        writeln!(
            out,
            "zone {}: eye {} m, up to {} m, hidden counts for {}, {} bytes",
            zone.name,
            zone.eye,
            ceilings.join(", "),
            zone.hidden,
            zone.bytes
        )?;
    }
    if i.verified {
        writeln!(out, "verified: every blob matches its checksum and decodes")?;
    }
    Ok(())
}

fn triangles(out: &mut impl Write, i: &TinInspection, about: &Layer) -> std::io::Result<()> {
    writeln!(
        out,
        "  level  diamonds        bytes    triangles   error min [m]   error max [m]   borders [m]   (tin)"
    )?;
    for l in &i.levels {
        // How many there are is known once they are decoded.
        let triangles = l.triangles.map_or_else(|| "-".to_owned(), |n| n.to_string());
        writeln!(
            out,
            "  {:>5} {:>9} {:>12} {triangles:>12} {:>15} {:>15} {:>13.1}",
            l.level, l.diamonds, l.bytes, l.error_min, l.error_max, l.apart_max
        )?;
    }
    writeln!(out, "  finest error {} m (asked: {} m), errors {}", i.finest_error, about.max_error, i.errors)?;
    writeln!(
        out,
        "  {} triangles in {} bytes, {:.3} bits each; {} bytes of index",
        i.triangles, i.bytes, i.bits_per_triangle, i.index_bytes
    )?;
    if !i.cuts.is_empty() {
        let cuts: Vec<String> = i.cuts.iter().map(|c| format!("{} m {}", c.error, c.triangles)).collect();
        writeln!(out, "  triangles of the coarsest cut that keeps an error: {}", cuts.join(", "))?;
    }
    Ok(())
}

pub(super) fn zone(out: &mut impl Write, store: &Path, r: &zone::Report) -> std::io::Result<()> {
    let share = |some: u64, all: u64| 100.0 * some as f64 / all.max(1) as f64;
    writeln!(
        out,
        "{}: scene '{}', version {} (was {})",
        store.display(),
        r.scene,
        r.version,
        r.version_before
    )?;
    writeln!(
        out,
        "  zone '{}': {} polygon{}, up to {:.3} m, {} eyes {:.1} m apart, {} azimuths",
        r.zone.name,
        r.zone.parts.len(),
        if r.zone.parts.len() == 1 { "" } else { "s" },
        r.zone.parts.iter().map(|part| part.ceiling).fold(f64::NEG_INFINITY, f64::max),
        r.eyes,
        r.spacing,
        r.azimuths
    )?;
    writeln!(
        out,
        "  {:.1} % of {} samples are seen, {:.1} % are hidden, the rest counts in between; of {} diamonds {:.1} % are hidden",
        share(r.samples_seen, r.samples),
        r.samples,
        share(r.samples_hidden, r.samples),
        r.diamonds,
        share(r.diamonds_hidden, r.diamonds)
    )?;
    writeln!(
        out,
        "  {} bytes; {:.1} s: heights {:.1} s, rays {:.1} s",
        r.zone.bytes, r.seconds, r.seconds_reading, r.seconds_casting
    )
}

pub(super) fn experiment(
    out: &mut impl Write,
    folder: &Path,
    report: &experiment::report::Report,
) -> std::io::Result<()> {
    writeln!(out, "{}", report.title)?;
    for note in &report.notes {
        writeln!(out, "  {note}")?;
    }
    for table in &report.tables {
        let file = folder.join(format!("{}.csv", table.name));
        writeln!(out, "  {}: {} rows in {}", table.caption, table.rows.len(), file.display())?;
    }
    writeln!(out, "Next: open {}", folder.join("report.html").display())
}
