//! Series of water surfaces in time: which step of each is drawn, and which are fetched ahead.
//!
//! A step is a layer, and at any moment one of a series is drawn. When time goes on to another, that one is *awaited*,
//! and the one before *stays* until the new one covers the view, with its roots at least: there is never a hole. While
//! time runs, the next steps are fetched *ahead*, as the present view wants them. All others are *idle*: they keep what is
//! resident of them until the room is needed, roots too, and hold nothing else but [`IDLE_PAGES`] of their index.
//!
//! All steps of a series have the memory of one layer. What is drawn takes of it what it wants; who comes later has what
//! is left. Requests likewise: what is wanted ahead comes after all else.

use super::{LayerState, Terrain};
use crate::cut::Ideal;
use crate::fetch::{self, Want};
use crate::morph::Morphs;
use crate::player::{Course, coming};
use diamantina_protocol::message::{Kind, Layer, Scene};
use diamantina_protocol::series::Series;

/// Steps that are fetched ahead, as far as there is memory.
pub const AHEAD_MAX: usize = 4;

/// Pages of the index that an idle step keeps, of some 40 kB: one tells of up to 1087 diamonds.
const IDLE_PAGES: usize = 2;

/// What a layer is for, in a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) enum Role {
    /// It is drawn, and all that it lacks is asked for. Layers that are no steps are always for this.
    #[default]
    Drawn,
    /// It is drawn until another step is there; nothing more of it is asked for.
    Stays,
    /// The step of the present time, which is to be drawn as soon as its roots are there.
    Awaited,
    /// A step that comes next.
    Ahead,
    /// Neither drawn nor asked for.
    Idle,
}

/// The series of a scene, and the time.
#[derive(Debug, Default)]
pub(super) struct Steps {
    pub(super) seconds: f64,
    pub(super) course: Option<Course>,
    all: Vec<One>,
    /// Of each layer its series.
    of: Vec<Option<usize>>,
    /// Counts frames: of the steps ahead, one is looked at in each.
    frames: usize,
}

/// A series.
#[derive(Debug)]
struct One {
    /// The layers that are its steps.
    layers: Vec<usize>,
    drawn: usize,
    /// That of the present time.
    wanted: usize,
    /// The nearest first; without `drawn`.
    ahead: Vec<usize>,
}

impl Steps {
    /// Those of a scene, at a time.
    pub(super) fn of(scene: &Scene, seconds: f64) -> Self {
        let layers = scene.layers.iter().map(|layer| (layer.name.as_str(), layer.kind == Kind::Water));
        // The scene was checked when it came.
        let positions = Series::positions(&scene.series, layers).unwrap_or_default();
        let mut of = vec![None; scene.layers.len()];
        for (number, layers) in positions.iter().enumerate() {
            layers.iter().for_each(|layer| of[*layer] = Some(number));
        }
        let one = |layers: Vec<usize>| One { layers, drawn: 0, wanted: 0, ahead: Vec::new() };
        let mut steps =
            Self { seconds: 0.0, course: None, all: positions.into_iter().map(one).collect(), of, frames: 0 };
        steps.set(scene, seconds, None);
        for one in &mut steps.all {
            one.drawn = one.wanted;
        }
        steps
    }

    /// Sets the time, and where it goes.
    fn set(&mut self, scene: &Scene, seconds: f64, course: Option<Course>) {
        if seconds.is_finite() {
            self.seconds = seconds;
        }
        self.course = course;
        for (one, series) in self.all.iter_mut().zip(&scene.series) {
            one.wanted = series.step_at(self.seconds);
        }
    }

    /// The series that a layer is a step of.
    pub(super) fn series_of(&self, layer: usize) -> Option<usize> {
        self.of.get(layer).copied().flatten()
    }

    /// Whether a layer is what is to be seen at the present time: any that is no step, and of a series one.
    pub(super) fn is_wanted(&self, layer: usize) -> bool {
        self.series_of(layer).is_none_or(|number| {
            let one = &self.all[number];
            one.layers[one.wanted] == layer
        })
    }

    /// What a layer is for.
    fn role(&self, layer: usize) -> Role {
        let Some(number) = self.series_of(layer) else { return Role::Drawn };
        let One { layers, drawn, wanted, ahead } = &self.all[number];
        if layers[*drawn] == layer {
            return if drawn == wanted { Role::Drawn } else { Role::Stays };
        }
        if layers[*wanted] == layer {
            return Role::Awaited;
        }
        if ahead.iter().any(|step| layers[*step] == layer) { Role::Ahead } else { Role::Idle }
    }

    /// Decides what is drawn and what comes next. `covers` says whether all roots of a layer are there.
    fn turn(&mut self, covers: impl Fn(usize) -> bool) {
        self.frames += 1;
        for one in &mut self.all {
            let covers = |step: usize| covers(one.layers[step]);
            if one.drawn != one.wanted && (covers(one.wanted) || !covers(one.drawn)) {
                one.drawn = one.wanted;
            }
            let course = self.course;
            let next = course.map(|course| coming(one.wanted, one.layers.len(), course, AHEAD_MAX));
            one.ahead = next.unwrap_or_default();
            one.ahead.retain(|step| *step != one.drawn);
        }
    }

    /// The layers of a series that anything is wanted of, those first that have the first right to memory.
    fn in_use(&self, number: usize) -> impl Iterator<Item = usize> + '_ {
        let One { layers, drawn, wanted, ahead } = &self.all[number];
        let awaited = (drawn != wanted).then_some(*wanted);
        [*drawn].into_iter().chain(awaited).chain(ahead.iter().copied()).map(|step| layers[step])
    }

    /// Those that come next, the nearest first.
    pub(super) fn ahead(&self) -> Vec<usize> {
        self.all.iter().flat_map(|one| one.ahead.iter().map(|step| one.layers[*step])).collect()
    }

    /// Layers that are looked at in this frame, in this order. Of the steps ahead it is one of each series, in turn: each
    /// takes as long as what is drawn.
    pub(super) fn order(&self, layers: &[LayerState]) -> Vec<(usize, Role)> {
        let mut order = Vec::new();
        for role in [Role::Drawn, Role::Stays, Role::Awaited] {
            let all = layers.iter().enumerate().filter(|(_, state)| state.shown && state.role == role);
            order.extend(all.map(|(number, _)| (number, role)));
        }
        for one in self.all.iter().filter(|one| !one.ahead.is_empty()) {
            let layer = one.layers[one.ahead[self.frames % one.ahead.len()]];
            if layers[layer].shown {
                order.push((layer, Role::Ahead));
            }
        }
        order
    }

    /// Bytes that the cut of a layer may take: of a step what those before it leave.
    pub(super) fn room(&self, layer: usize, layers: &[LayerState]) -> usize {
        let Some(number) = self.series_of(layer) else { return layers[layer].memory_bytes };
        let before = self.in_use(number).take_while(|other| *other != layer);
        let taken: usize = before.map(|other| layers[other].ideal.bytes()).sum();
        layers[layer].memory_bytes.saturating_sub(taken)
    }
}

impl Terrain {
    /// The time of the scene's series, in seconds.
    #[must_use]
    pub fn time(&self) -> f64 {
        self.steps.seconds
    }

    /// Has the scene's series show what there is at a time, from the next frame on: the step before stays until it is
    /// there. Where time runs, the next steps are fetched ahead.
    pub fn set_time(&mut self, seconds: f64, course: Option<Course>) {
        self.steps.set(&self.scene, seconds, course);
    }

    /// Whether nothing is missing any more of what the present view will want at a time: either it is shown already, or it
    /// was fetched ahead. What has failed is not waited for.
    #[must_use]
    pub fn is_ready_at(&self, seconds: f64) -> bool {
        self.steps.all.iter().zip(&self.scene.series).all(|(one, series)| {
            let step = series.step_at(seconds);
            let state = &self.layers[one.layers[step]];
            let is_ahead = state.role == Role::Ahead && state.ahead.is_some() && !state.lacks;
            !state.shown || step == one.wanted || is_ahead
        })
    }

    /// The step of a series that is drawn, if all its roots are there.
    #[must_use]
    pub fn step_drawn(&self, series: usize) -> Option<usize> {
        let one = self.steps.all.get(series)?;
        self.covers(one.layers[one.drawn]).then_some(one.drawn)
    }

    /// How many steps of series that come next are there already.
    #[must_use]
    pub fn steps_ahead(&self) -> usize {
        let is_there = |layer: &usize| self.layers[*layer].ahead.is_some() && !self.layers[*layer].lacks;
        self.steps.ahead().iter().filter(|layer| is_there(layer)).count()
    }

    /// Whether a layer, by its position in the scene, is a step of a series.
    #[must_use]
    pub fn is_step(&self, layer: usize) -> bool {
        self.steps.series_of(layer).is_some()
    }

    /// The layers that are drawn, in the scene's order: of a series the step that is, by the name of the series.
    #[must_use]
    pub fn drawn_layers(&self) -> Vec<Layer> {
        let is_drawn = |(state, _): &(&LayerState, &Layer)| {
            state.shown && matches!(state.role, Role::Drawn | Role::Stays)
        };
        let layers = self.layers.iter().zip(&self.scene.layers).filter(is_drawn);
        let named = |(_, layer): (&LayerState, &Layer)| Layer {
            name: self.scene.chosen_as(&layer.name).to_owned(),
            ..layer.clone()
        };
        layers.map(named).collect()
    }

    /// Whether all roots of a layer that hold anything are there.
    fn covers(&self, layer: usize) -> bool {
        let (state, forest) = (&self.layers[layer], &self.scene.layers[layer].forest);
        forest.root_diamonds().all(|root| {
            let is_empty = state.index.get(root).is_some_and(|entry| entry.is_empty());
            is_empty || self.cache.get((layer, root)).is_some()
        })
    }

    /// Gives the steps of series what they are for in this frame.
    pub(super) fn turn_steps(&mut self) {
        if self.steps.all.is_empty() {
            return;
        }
        let mut steps = std::mem::take(&mut self.steps);
        steps.turn(|layer| self.covers(layer));
        let mut is_same = true;
        for (number, state) in self.layers.iter_mut().enumerate() {
            let role = if state.shown { steps.role(number) } else { Role::Idle };
            if !steps.of[number].is_some_and(|_| role != state.role) {
                continue;
            }
            is_same = false;
            state.morphs = Morphs::new(self.options.morph_seconds);
            state.appears = role == Role::Drawn;
            state.ahead = None;
            state.lacks = true;
            if role == Role::Idle {
                state.ideal = Ideal::default();
                state.index.trim(IDLE_PAGES, std::iter::empty());
            }
            self.cache.keep_roots(number, role != Role::Idle);
            state.role = role;
        }
        self.steps = steps;
        if !is_same {
            self.share_out();
        }
    }

    /// Forgets what is wanted ahead and has no room beside what is drawn now: it is looked at again in its turn. The roots
    /// of the next step have room in any case.
    pub(super) fn fit_ahead(&mut self) {
        for number in 0..self.steps.all.len() {
            let mut taken = 0;
            let ahead = &self.steps.all[number].ahead;
            let later: Vec<usize> =
                ahead.iter().skip(1).map(|step| self.steps.all[number].layers[*step]).collect();
            for layer in self.steps.in_use(number) {
                let state = &mut self.layers[layer];
                taken += state.ideal.bytes();
                if later.contains(&layer) && taken > state.memory_bytes {
                    state.ideal = Ideal::default();
                    state.ahead = None;
                }
            }
        }
    }

    /// Adds what is wanted ahead to what is wanted now, as far as there is room for it on its way.
    pub(super) fn want_ahead(&mut self, wants: &mut Vec<Want>, room: &mut usize) {
        for layer in self.steps.ahead() {
            let state = &mut self.layers[layer];
            let Some(mut wishes) = state.ahead.take() else { continue };
            wishes.retain(|wish| self.cache.get((layer, wish.diamond)).is_none());
            let pages = state.ideal.pages().iter().map(|page| fetch::Key::Page(layer, *page));
            let pages: Vec<fetch::Key> = pages.filter(|key| !state.has_page(key)).collect();
            let diamonds = wishes.iter().map(|wish| fetch::Key::Diamond(layer, wish.diamond));
            let has_failed = pages.iter().copied().chain(diamonds).any(|key| self.failed.contains(&key));
            state.lacks = !(has_failed || wishes.is_empty() && state.ideal.pages().is_empty());
            wants.extend(pages.into_iter().map(|key| Want { key, bytes: None }));
            for wish in &wishes {
                if *room == 0 {
                    break;
                }
                self.want((layer, *wish), wants, room);
            }
            self.layers[layer].ahead = Some(wishes);
        }
    }
}

impl LayerState {
    /// Whether a page of its index is there.
    fn has_page(&self, key: &fetch::Key) -> bool {
        matches!(key, fetch::Key::Page(_, page) if self.index.has(*page))
    }
}
