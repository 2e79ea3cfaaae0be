//! A flight along a path, with a line of figures for each frame.

use super::{Annotator, FlightPath, HeadlessError, save, take_room};
use crate::overview::stretched;
use crate::picture::Picture;
use crate::player::{self, Course};
use crate::render::{self, Look, Offscreen};
use crate::terrain::Terrain;
use serde::Serialize;
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// How water that changes with time goes on while a path is flown.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Play {
    /// Seconds of it for a second of the path; below 0: backwards; 0: it stands.
    pub speed: f64,
    /// Whether it begins again after the last step.
    pub is_round: bool,
}

/// How to fly.
#[derive(Debug, Clone)]
pub struct Flight {
    /// How water that changes with time goes on, from the terrain's time.
    pub play: Play,
    /// Frames to draw.
    pub frames: u32,
    /// Frames a second at most; 0: as fast as they can be drawn.
    pub frames_a_second: f64,
    /// Width and height, in pixels.
    pub size: [u32; 2],
    /// A folder for a PNG of each frame.
    pub pictures: Option<PathBuf>,
    /// Whether pictures come back from the graphics adapter even where they are not written; else each frame waits until
    /// it is drawn.
    pub reads: bool,
    /// Let each frame wait up to so long for data, so that what a flight takes follows from its path alone.
    pub patience: Option<Duration>,
}

/// One frame of a flight: a line of the CSV.
#[derive(Debug, Clone, Serialize)]
pub struct FrameLine {
    /// From 0.
    pub frame: u32,
    /// Seconds since the start.
    pub seconds: f64,
    /// Milliseconds to choose the cut and take what has arrived.
    pub cut_ms: f64,
    /// Milliseconds to upload and draw, until the picture is there; and to read it back, where pictures are.
    pub draw_ms: f64,
    /// The largest error of what is drawn, in pixels, as in [`super::PictureReport`]; `inf` until all roots are there.
    pub error_pixels: f64,
    /// The error of the ideal cut.
    pub goal_pixels: f64,
    /// Whether all that the ideal cut wants is there.
    pub complete: bool,
    /// Diamonds in motion.
    pub moving: usize,
    /// Diamonds drawn.
    pub diamonds: usize,
    /// Triangles drawn.
    pub triangles: u64,
    /// Draw calls.
    pub draws: u32,
    /// Bytes uploaded to the GPU for this frame.
    pub uploaded_bytes: u64,
    /// Bytes of surfaces on the GPU.
    pub gpu_bytes: u64,
    /// Diamonds resident.
    pub resident: usize,
    /// Bytes of memory that they take.
    pub resident_bytes: usize,
    /// Bytes received so far.
    pub bytes: u64,
    /// Requests sent so far.
    pub requests: u64,
    /// Round trips so far.
    pub round_trips: u64,
    /// Real points received so far.
    pub real_points: u64,
    /// Fictitious points deduced so far.
    pub fictitious_points: u64,
    /// Whether the eye was in the zone that was asked for: see [`super::PictureReport::zone_in_effect`].
    pub zone_in_effect: bool,
    /// Bytes of GPU memory that all else takes: see [`crate::render::FrameStats::fixed_bytes`].
    pub gpu_fixed_bytes: u64,
    /// Bytes so far that were fetched before, and came from the disk.
    pub disk_bytes: u64,
    /// Whether the server was not asked.
    pub offline: bool,
    /// Whether memory, here or on the GPU, kept the ideal cut from the asked error.
    pub limited_by_memory: bool,
    /// The time of water that changes with it, in seconds.
    pub time_seconds: f64,
    /// Series of which an earlier step was drawn, since that of this time had not arrived.
    pub late: usize,
    /// Steps of series that come next and were there already.
    pub steps_ahead: usize,
    /// Bytes of GPU memory that all takes: those of surfaces and the others.
    pub gpu_total_bytes: u64,
}

impl FrameLine {
    /// The heading of the CSV.
    pub const HEADING: &str = "frame,seconds,cut_ms,draw_ms,error_pixels,goal_pixels,complete,moving,diamonds,triangles,draws,uploaded_bytes,gpu_bytes,resident,resident_bytes,bytes,requests,round_trips,real_points,fictitious_points,zone_in_effect,gpu_fixed_bytes,disk_bytes,offline,limited_by_memory,time_seconds,late,steps_ahead,gpu_total_bytes";

    /// The line, with the fields of the heading.
    #[must_use]
    pub fn csv(&self) -> String {
        format!(
            "{},{:.4},{:.3},{:.3},{:.4},{:.4},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{:.4},{},{},{}",
            self.frame,
            self.seconds,
            self.cut_ms,
            self.draw_ms,
            self.error_pixels,
            self.goal_pixels,
            self.complete,
            self.moving,
            self.diamonds,
            self.triangles,
            self.draws,
            self.uploaded_bytes,
            self.gpu_bytes,
            self.resident,
            self.resident_bytes,
            self.bytes,
            self.requests,
            self.round_trips,
            self.real_points,
            self.fictitious_points,
            self.zone_in_effect,
            self.gpu_fixed_bytes,
            self.disk_bytes,
            self.offline,
            self.limited_by_memory,
            self.time_seconds,
            self.late,
            self.steps_ahead,
            self.gpu_total_bytes,
        )
    }
}

/// Flies along a path while data stream in. Unless told to, no frame waits for them: each draws what is there. `each` sees
/// every frame's line and picture as soon as it is drawn. Motions take the path's time, not the wall's: so a flight
/// looks the same however long its frames take.
///
/// # Errors
/// When there is no graphics adapter, or no memory on it for such pictures, a picture cannot be written, or `each` says so.
pub fn fly(
    terrain: &mut Terrain,
    path: &FlightPath,
    flight: &Flight,
    look: &Look,
    options: &render::Options,
    mut each: impl FnMut(&FrameLine, Option<&Picture>) -> Result<(), HeadlessError>,
) -> Result<(), HeadlessError> {
    let mut offscreen = Offscreen::new(options)?;
    terrain.suit_blocks(offscreen.reads_blocks());
    terrain.set_exaggeration(look.exaggeration);
    // Of a version of the scene.
    let mut annotator: Option<(String, Annotator)> = None;
    terrain.set_wires(look.wireframe);
    terrain.set_mirrors(look.mirrors().then_some(look.water.mirror_error));
    take_room(terrain, &offscreen, flight.size, look)?;
    let (play, from) = (flight.play, terrain.time());
    let is_playing = play.speed != 0.0;
    let course = is_playing.then_some(Course { is_backward: play.speed < 0.0, is_round: play.is_round });
    let started = Instant::now();
    for frame in 0..flight.frames {
        if flight.frames_a_second > 0.0 {
            let due = Duration::from_secs_f64(f64::from(frame) / flight.frames_a_second);
            std::thread::sleep(due.saturating_sub(started.elapsed()));
        }
        let part = f64::from(frame) / f64::from((flight.frames - 1).max(1));
        let camera = path.camera(part, flight.size);
        let clock = Instant::now();
        let drawn = stretched(&camera, look.exaggeration);
        let seconds = part * path.seconds();
        if is_playing {
            // It follows the path and waits for nothing: flights can be compared.
            let time = player::time_at(&terrain.scene().series, from, seconds, play.speed, play.is_round);
            terrain.set_time(time, course);
        }
        if let Some(patience) = flight.patience {
            terrain.settle_at(&drawn, seconds, patience);
        }
        let clock = flight.patience.map_or(clock, |_| Instant::now());
        let view = terrain.frame_at(&drawn, seconds);
        let cut_ms = clock.elapsed().as_secs_f64() * 1e3;
        let clock = Instant::now();
        // Waves move in the path's time, too.
        let mut look = *look;
        look.water.seconds += seconds;
        // Of this frame's version: another may have taken over, and lie elsewhere.
        offscreen.drape(view.drape.as_ref());
        offscreen.mirror(&view.mirrors);
        let stats = offscreen.draw(&terrain.scene().layers, &drawn, &view.items, &look)?;
        if look.annotations.is_any() {
            let version = &terrain.scene().version;
            let kept = annotator.take().filter(|(of, _)| of == version);
            let (_, annotator) =
                annotator.insert(kept.unwrap_or_else(|| (version.clone(), Annotator::new(terrain.scene()))));
            annotator.annotate(&mut offscreen, terrain, &drawn, &view.items, &look);
        }
        let picture = if flight.reads || flight.pictures.is_some() {
            Some(offscreen.read()?)
        } else {
            offscreen.wait()?;
            None
        };
        let draw_ms = clock.elapsed().as_secs_f64() * 1e3;
        let line = FrameLine {
            frame,
            seconds: started.elapsed().as_secs_f64(),
            cut_ms,
            draw_ms,
            error_pixels: view.error_pixels,
            goal_pixels: view.error_pixels_goal,
            complete: view.complete,
            moving: view.moving,
            diamonds: view.items.len(),
            triangles: stats.triangles,
            draws: stats.draws,
            uploaded_bytes: stats.uploaded_bytes,
            gpu_bytes: stats.gpu_bytes,
            resident: view.stats.resident,
            resident_bytes: view.stats.resident_bytes,
            bytes: view.stats.traffic.bytes,
            requests: view.stats.traffic.requests,
            round_trips: view.stats.traffic.round_trips,
            real_points: view.stats.points_real,
            fictitious_points: view.stats.points_fictitious,
            zone_in_effect: view.stats.zone_in_effect,
            gpu_fixed_bytes: stats.fixed_bytes,
            disk_bytes: view.stats.traffic.disk_bytes,
            offline: view.stats.offline,
            limited_by_memory: view.limited,
            time_seconds: terrain.time(),
            late: view.late,
            steps_ahead: view.stats.steps_ahead,
            gpu_total_bytes: stats.total_bytes(),
        };
        if let (Some(folder), Some(picture)) = (&flight.pictures, &picture) {
            save(picture, &folder.join(format!("frame-{frame:05}.png")))?;
        }
        each(&line, picture.as_ref())?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_csv_has_as_many_fields_as_its_heading() {
        let line = FrameLine {
            frame: 1,
            seconds: 2.0,
            cut_ms: 3.0,
            draw_ms: 4.0,
            error_pixels: f64::INFINITY,
            goal_pixels: 0.5,
            complete: false,
            moving: 0,
            diamonds: 1,
            triangles: 2,
            draws: 3,
            uploaded_bytes: 4,
            gpu_bytes: 5,
            resident: 6,
            resident_bytes: 7,
            bytes: 8,
            requests: 9,
            round_trips: 10,
            real_points: 11,
            fictitious_points: 12,
            zone_in_effect: true,
            gpu_fixed_bytes: 13,
            disk_bytes: 14,
            offline: false,
            limited_by_memory: true,
            time_seconds: 14.5,
            late: 1,
            steps_ahead: 2,
            gpu_total_bytes: 18,
        };
        assert_eq!(line.csv().split(',').count(), FrameLine::HEADING.split(',').count());
        let json = serde_json::to_value(&line).unwrap();
        for name in FrameLine::HEADING.split(',') {
            assert!(json.get(name).is_some(), "{name}");
        }
    }
}
