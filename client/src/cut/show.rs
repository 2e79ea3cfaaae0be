//! What to draw of a cut that is in motion.
//!
//! While diamonds move, more are drawn as split than the index asks for, and some that it asks for are not yet: so
//! the triangles and their error follow from the set of split diamonds, whatever chose it.

use super::near::{self, Near};
use super::{Ask, Ideal, unknown};
use crate::camera::Plane;
use crate::drawing::{DrawItem, Moving, Share};
use crate::morph::{self, Moment, Sight};
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::index::Entry;
use foldhash::fast::RandomState;
use std::collections::HashMap;
use std::sync::Arc;

/// An error of fewer pixels than this comes and goes without a motion: nobody sees it.
const STILL_PIXELS: f64 = 0.1;

/// What is seen of a diamond that is drawn unsplit.
#[derive(Debug, Clone, Copy)]
struct Seen {
    in_view: bool,
    pixels: f64,
}

/// What is drawn of a cut in motion.
#[derive(Debug, Default)]
pub struct Showing {
    /// The triangles to draw; those out of view are left out.
    pub items: Vec<DrawItem>,
    /// The largest error, in pixels, of what moves or waits: of diamonds that count as not yet split.
    pub error_pixels: f64,
}

/// What [`morph::Change`] asks of a diamond, if the last frame saw what is within `last`.
#[must_use]
pub fn sight(ask: &Ask, ideal: &Ideal, d: Diamond, entry: Option<Entry>, last: &[Plane]) -> Sight {
    let entry = entry.unwrap_or_else(|| unknown(ask.layer));
    let Seen { in_view, pixels } = seen(ask, ideal, d, Some(entry));
    let visible = in_view && pixels >= STILL_PIXELS && ask.bounds(d, &entry).touches(last);
    Sight { visible, error_metres: entry.error_metres }
}

/// The triangles of a cut in motion at a moment, and its error. `entry` looks a diamond up in the index.
#[must_use]
pub fn show(
    number: usize,
    ask: &Ask,
    ideal: &Ideal,
    entry: impl Fn(Diamond) -> Option<Entry>,
    cut: &morph::Cut,
    now: Moment,
) -> Showing {
    let forest = &ask.layer.forest;
    let seen = |d: Diamond| seen(ask, ideal, d, entry(d));
    // Those that are split, and in which share of the pixels.
    let share = |shown: &morph::Shown| shown.motion.as_ref().map_or(1.0, |motion| motion.share(now));
    let split: HashMap<Diamond, f32, RandomState> =
        cut.shown.iter().map(|shown| (shown.diamond, share(shown))).collect();
    let (mut showing, mut errors) = (Showing::default(), Vec::new());
    for shown in &cut.shown {
        let d = shown.diamond;
        if let Some(motion) = shown.motion.as_ref().filter(|_| seen(d).in_view) {
            let entry = entry(d).unwrap_or_else(|| unknown(ask.layer));
            errors.push(Near {
                diamond: d,
                surface: &shown.surface,
                level: d.level(),
                error_metres: motion.error_metres(),
                lift_metres: f64::from(motion.span()) * ask.layer.quantum,
                pixels: ask.pixels(d, d.level(), motion.error_metres(), &ask.bounds(d, &entry)),
            });
        }
        let mut sides = 0;
        if d.level() + 1 == forest.levels() {
            // The finest triangles belong to no child.
            let all = if forest.local(d).upper { 0b1111 } else { 0b11 };
            sides = if seen(d).in_view { all } else { 0 };
        }
        let share = split[&d];
        let mut item = |sides: u8, from: f32| {
            let moves = shown.surface.points().is_some();
            let moving = shown.motion.clone().filter(|_| moves).map(|motion| Moving { motion, now });
            let (surface, share) = (Arc::clone(&shown.surface), Share([from, share]));
            showing.items.push(DrawItem { layer: number, diamond: d, surface, sides, moving, share });
        };
        for (side, child) in forest.children(d).into_iter().enumerate() {
            let Some(child) = child.filter(|child| seen(*child).in_view) else { continue };
            match split.get(&child) {
                None => sides |= 1 << side,
                // Where the child is not seen yet, or any more, this is.
                Some(part) if *part < share => item(1 << side, *part),
                Some(_) => {}
            }
        }
        if sides != 0 && share > 0.0 {
            item(sides, 0.0);
        }
    }
    let mut pixels: Vec<f64> = errors.iter().map(|error| error.pixels).collect();
    near::refine(ask, &errors, |at, less| pixels[at] = less);
    showing.error_pixels = pixels.into_iter().fold(0.0, f64::max);
    for d in &cut.waiting {
        showing.error_pixels = showing.error_pixels.max(seen(*d).pixels);
    }
    showing
}

/// As the cut saw it, if it looked at the diamond.
fn seen(ask: &Ask, ideal: &Ideal, d: Diamond, entry: Option<Entry>) -> Seen {
    if let Some(number) = ideal.numbers.get(&d) {
        let node = ideal.node(*number);
        return Seen { in_view: node.in_view && !node.entry.is_empty(), pixels: node.pixels };
    }
    let entry = entry.unwrap_or_else(|| unknown(ask.layer));
    let bounds = ask.bounds(d, &entry);
    let in_view = !entry.is_empty() && bounds.touches(&ask.camera.planes());
    Seen {
        in_view,
        pixels: if in_view { ask.pixels(d, d.level(), entry.error_metres, &bounds) } else { 0.0 },
    }
}
