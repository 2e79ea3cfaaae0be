//! The first view of a scene, watched frame by frame while it comes: the error on screen over time, from before the
//! scene's description is asked for.
//!
//! Without a GPU: what a frame would show is known before it is drawn, and drawing is no matter of the link.

use diamantina_client::camera::Camera;
use diamantina_client::terrain::{FrameView, Options, Terrain, TerrainError};
use diamantina_protocol::message::Scene;
use std::time::{Duration, Instant};

/// Frames that are watched once all is there: what is there must stay.
const FRAMES_AFTER: usize = 5;

/// How a view is watched.
#[derive(Debug, Clone)]
pub(crate) struct Watch {
    /// How the client streams.
    pub(crate) options: Options,
    /// Whether the view is asked for as one stream.
    pub(crate) streamed: bool,
    /// From frame to frame.
    pub(crate) pause: Duration,
    /// When the watcher gives up.
    pub(crate) patience: Duration,
}

/// What a frame showed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Seen {
    /// Seconds since before the scene's description was asked for.
    pub(crate) seconds: f64,
    /// The largest declared error on screen, in pixels; infinite while the view is not covered.
    pub(crate) error_pixels: f64,
    /// Bytes of answers so far.
    pub(crate) bytes: u64,
    /// Whether all that the asked error needs is there: where the store is coarser, that error is not reached.
    pub(crate) complete: bool,
}

/// What all frames showed.
#[derive(Debug)]
pub(crate) struct Watched {
    pub(crate) seen: Vec<Seen>,
    /// The last frame.
    pub(crate) last: FrameView,
}

impl Watched {
    /// The first frame within an error in pixels.
    pub(crate) fn within(&self, pixels: f64) -> Option<Seen> {
        self.seen.iter().copied().find(|seen| seen.error_pixels <= pixels)
    }

    /// The first frame that covers the view, however coarsely.
    pub(crate) fn first_picture(&self) -> Option<Seen> {
        self.within(f64::MAX)
    }

    /// The first frame within the asked error or, where the store is coarser, with all that it has.
    pub(crate) fn asked(&self, pixels: f64) -> Option<Seen> {
        self.seen.iter().copied().find(|seen| seen.complete || seen.error_pixels <= pixels)
    }

    /// Two frames one after another of which the later is worse, if there are any.
    pub(crate) fn growth(&self) -> Option<[Seen; 2]> {
        self.seen.array_windows().copied().find(|[a, b]| b.error_pixels > a.error_pixels)
    }
}

/// Opens a scene and looks at it until all that the view wants is there. `camera` chooses the view from the scene's
/// description; from then on the eye stands still.
pub(crate) fn watch(
    url: &str,
    watch: &Watch,
    camera: impl Fn(&Scene) -> Camera,
) -> Result<Watched, TerrainError> {
    let started = Instant::now();
    let mut terrain = Terrain::open(url, watch.options.clone())?;
    let camera = camera(terrain.scene());
    if watch.streamed {
        terrain.stream(&camera);
    }
    let (mut seen, mut after) = (Vec::new(), 0);
    loop {
        let view = terrain.frame(&camera);
        let seconds = started.elapsed().as_secs_f64();
        let (error_pixels, bytes, complete) = (view.error_pixels, view.stats.traffic.bytes, view.complete);
        seen.push(Seen { seconds, error_pixels, bytes, complete });
        after += usize::from(view.complete);
        if after > FRAMES_AFTER || started.elapsed() >= watch.patience {
            return Ok(Watched { seen, last: view });
        }
        // Frames come at their own times, however long each takes.
        let next = watch.pause.mul_f64((seconds / watch.pause.as_secs_f64()).floor() + 1.0);
        std::thread::sleep(next.saturating_sub(started.elapsed()));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::link::{Link, Shape};
    use crate::world::World;
    use diamantina_client::headless;

    #[test]
    fn a_frame_that_is_worse_is_found() {
        let seen = |error_pixels| Seen { seconds: 0.0, error_pixels, bytes: 0, complete: false };
        let watched = |errors: &[f64]| Watched {
            seen: errors.iter().copied().map(seen).collect(),
            last: FrameView::default(),
        };
        assert_eq!(watched(&[f64::INFINITY, f64::INFINITY, 9.0, 9.0, 2.0]).growth(), None);
        assert_eq!(watched(&[f64::INFINITY, 9.0, 2.0, 2.5, 1.0]).growth(), Some([seen(2.0), seen(2.5)]));
        assert!(watched(&[9.0, f64::INFINITY]).growth().is_some());
    }

    #[test]
    fn over_a_slow_link_the_error_never_grows_and_the_asked_one_is_reached() {
        let world = World::whole(1025);
        let shape = Shape { bits_per_second: 8e6, round_trip: Duration::from_millis(40) };
        let mut bytes = Vec::new();
        for streamed in [false, true] {
            let link = Link::start(&world.served.address, shape).unwrap();
            let watched = watch(
                &format!("{}/scenes/world", link.address),
                &Watch {
                    options: Options::default(),
                    streamed,
                    pause: Duration::from_secs(1) / 60,
                    patience: Duration::from_secs(60),
                },
                |scene| headless::overview(scene, [1380, 768]),
            )
            .unwrap();
            let traffic = watched.last.stats.traffic;
            let first = watched.first_picture().expect("a picture");
            let asked = watched.asked(1.0).expect("the asked error");
            let improved =
                watched.seen.array_windows().filter(|[a, b]| b.error_pixels < a.error_pixels).count();
            println!("streamed {streamed}: {first:?}, {asked:?}, {improved} times better, {traffic:?}");
            assert_eq!(watched.growth(), None, "the eye stands still");
            assert!(watched.last.complete && watched.last.error_pixels <= 1.0);
            assert!(improved >= 2, "it gets better step by step");
            // What has arrived so far went over the link.
            let owed = shape.time(asked.bytes as usize) + shape.round_trip * 3;
            assert!(asked.seconds >= 0.9 * owed.as_secs_f64(), "{asked:?} before {owed:?}");
            // By the link's own arithmetic, four times over, and what a busy machine needs.
            let enough = owed.mul_f64(4.0) + Duration::from_secs(10);
            assert!(asked.seconds <= enough.as_secs_f64(), "{asked:?} after {enough:?}");
            assert!(first.seconds < asked.seconds && first.bytes < asked.bytes);
            assert_eq!(traffic.errors, 0);
            bytes.push(traffic.bytes);
        }
        assert!(bytes[1] as f64 <= 1.2 * bytes[0] as f64, "a stream brings what is wanted: {bytes:?}");
    }
}
