//! Cuts in motion: no crack and no jump at any moment.

use super::*;
use crate::{cut, sight};
use diamantina_protocol::index::Entry;

/// Seconds that a motion takes here, and frames in which it does.
const SECONDS: f64 = 0.25;
const FRAMES: u32 = 8;

/// Points of a diamond of n = 4.
const POINTS: usize = 5 * 5 + 4 * 4;

/// A cut that goes from frame to frame.
struct Play<'a> {
    world: &'a World,
    morphs: Morphs,
    frame: u32,
}

impl<'a> Play<'a> {
    fn new(world: &'a World) -> Self {
        Self { world, morphs: Morphs::new(SECONDS), frame: 0 }
    }

    /// So many diamonds of n = 4, the largest that there are here, begin in a frame: else all of such small ones would.
    fn beginning(world: &'a World, diamonds: usize) -> Self {
        let mut play = Self::new(world);
        play.morphs.set_starts_max(POINTS * diamonds);
        play
    }

    fn now(&self) -> Moment {
        Moment::at(f64::from(self.frame) * SECONDS / f64::from(FRAMES))
    }

    /// The next frame. `visible` tells of which diamonds a jump would be seen.
    fn step(&mut self, wanted: &HashSet<Diamond>, visible: impl Fn(Diamond) -> bool) -> morph::Cut {
        self.frame += 1;
        self.step_at(self.now(), wanted, visible)
    }

    /// A frame at a moment.
    fn step_at(
        &mut self,
        now: Moment,
        wanted: &HashSet<Diamond>,
        visible: impl Fn(Diamond) -> bool,
    ) -> morph::Cut {
        let change = Change {
            layer: &self.world.layer,
            now,
            wanted: &World::sorted(wanted),
            surface: &|d| self.world.surfaces.get(&d).cloned(),
            sight: &|d| Sight { visible: visible(d), error_metres: 0.5f32.powi(d.level() as i32) },
        };
        let mut morphs = std::mem::take(&mut self.morphs);
        let cut = morphs.step(&change);
        self.morphs = morphs;
        cut
    }

    /// What is drawn of a cut, all of it in view, at a moment.
    fn items(&self, cut: &morph::Cut, now: Moment) -> Vec<DrawItem> {
        let split: HashSet<Diamond> = cut.shown.iter().map(|shown| shown.diamond).collect();
        let forest = self.world.layer.forest;
        assert!(split.iter().all(|d| forest.parents(*d).all(|p| split.contains(&p))), "closed under parents");
        let mut items = self.world.cut(&split);
        for item in &mut items {
            let shown = cut.shown.iter().find(|shown| shown.diamond == item.diamond).unwrap();
            item.moving = shown.motion.clone().map(|motion| Moving { motion, now });
        }
        items
    }
}

/// A set of split diamonds that holds the parents of each: each diamond below the roots with a chance.
fn any_splits(forest: &Forest, seed: u64, chance: f64) -> HashSet<Diamond> {
    let mut split: HashSet<Diamond> = forest.root_diamonds().collect();
    for level in 1..forest.levels() {
        for d in forest.diamonds(level) {
            let [x, y] = d.centre();
            // The first numbers of seeds that are alike are alike.
            let mut dice = Dice(seed << 40 ^ u64::from(x) << 20 ^ u64::from(y));
            let roll = (0..4).map(|_| dice.roll()).last().unwrap();
            if roll < chance && forest.parents(d).all(|p| split.contains(&p)) {
                split.insert(d);
            }
        }
    }
    split
}

fn world() -> World {
    World::new(Forest::new(6, 2, [2, 1]).unwrap().with_precision(3).unwrap(), 30.0, rough)
}

/// Every point of the lattice.
fn points(forest: &Forest) -> impl Iterator<Item = [i64; 2]> + use<> {
    let [w, h] = forest.size().map(i64::from);
    (0..=h).flat_map(move |y| (0..=w).map(move |x| [x, y]))
}

#[test]
fn whatever_is_wanted_when_heights_never_jump_and_patches_agree() {
    let world = world();
    let forest = world.layer.forest;
    let mut play = Play::beginning(&world, 48);
    let mut last: Option<Vec<f64>> = None;
    let (mut moved, mut most, mut held, mut waited) = (0, 0.0f64, 0, 0);
    let mut last_span = 0.0;
    for round in 0..14u64 {
        let splits = any_splits(&forest, round, 0.55 + 0.1 * (round % 5) as f64);
        // Some rounds end half way, so that motions turn round.
        for _ in 0..=(round * 5 % 12) {
            let cut = play.step(&splits, |_| true);
            let items = play.items(&cut, play.now());
            let mut ground = Ground::new(forest, &items);
            let heights: Vec<f64> = points(&forest).map(|p| ground.height(p).unwrap()).collect();
            let span =
                cut.shown.iter().filter_map(|s| s.motion.as_ref()).map(|m| m.span()).fold(0.0, f32::max);
            // A smooth step is one and a half times as steep as a straight one. What ends between two frames takes its
            // last step without being in motion any more.
            let bound = f64::from(span.max(last_span)) * 1.5 / f64::from(FRAMES) + 0.01;
            last_span = span;
            for (a, b) in last.iter().flatten().zip(&heights) {
                assert!((a - b).abs() <= bound, "a jump of {} quanta, bound {bound}", (a - b).abs());
                most = most.max((a - b).abs());
            }
            moved += usize::from(cut.moving() > 0);
            (held, waited) = (held + cut.held, waited + cut.waiting.len());
            // The roots appear at once; all else moves.
            last = Some(heights);
        }
    }
    println!("{moved} frames with motions, largest step {most:.1} quanta; {held} held, {waited} waited");
    assert!(moved > 50 && most > 20.0 && held > 100 && waited > 100);
    // In the end it is what was wanted, and nothing moves.
    let splits = any_splits(&forest, 99, 0.8);
    let mut cut = play.step(&splits, |_| true);
    for _ in 0..20 * FRAMES {
        cut = play.step(&splits, |_| true);
    }
    assert_eq!(cut.moving(), 0);
    assert_eq!(cut.shown.iter().map(|s| s.diamond).collect::<HashSet<_>>(), splits);
}

#[test]
fn what_nobody_sees_jumps_and_patches_agree_all_the_same() {
    let hole = |x: u32, y: u32| (20..=33).contains(&x) && (12..=22).contains(&y);
    let forest = Forest::new(6, 2, [2, 1]).unwrap().with_precision(2).unwrap();
    let world = World::new(forest, 30.0, |x, y| if hole(x, y) { NODATA } else { rough(x, y) });
    let mut play = Play::new(&world);
    for round in 0..12 {
        let splits = any_splits(&forest, round, 0.85);
        for frame in 0..=(round * 3 % 7) {
            let cut =
                play.step(&splits, |d| !(d.centre()[0] + d.centre()[1] + frame as u32).is_multiple_of(3));
            drop(Ground::new(forest, &play.items(&cut, play.now())));
        }
    }
    let cut = play.step(&any_splits(&forest, 5, 0.9), |_| false);
    assert_eq!((cut.held, cut.waiting.len()), (0, 0));
}

#[test]
fn a_cut_in_motion_has_no_cracks() {
    let world = World::new(Forest::new(6, 2, [3, 2]).unwrap().with_precision(3).unwrap(), 30.0, rough);
    let camera = Camera {
        eye: world.place(0.5, 0.25, 900.0),
        target: world.place(0.5, 0.5, 100.0),
        fov_y: 0.5,
        size: [640, 400],
    };
    let mut offscreen = offscreen(1, 1 << 30);
    let mut play = Play::new(&world);
    for round in 0..4 {
        let splits = any_splits(&world.layer.forest, round, 0.6 + 0.1 * round as f64);
        for _ in 0..5 {
            let cut = play.step(&splits, |_| true);
            let items = play.items(&cut, play.now());
            offscreen.draw(std::slice::from_ref(&world.layer), &camera, &items, &PLAIN).unwrap();
            let picture = offscreen.read().unwrap();
            let all = (0..400).flat_map(|y| (0..640).map(move |x| (x, y)));
            let holes: Vec<_> = all.filter(|(x, y)| is_background(&picture, *x, *y)).collect();
            assert!(holes.is_empty(), "{} holes, first {:?}, {} move", holes.len(), holes[0], cut.moving());
        }
    }
}

/// Pixels of two pictures that differ by more than `levels` of 255 in a colour.
fn different(a: &Picture, b: &Picture, levels: u8) -> usize {
    let pixels = a.pixels.chunks(4).zip(b.pixels.chunks(4));
    pixels.filter(|(a, b)| a.iter().zip(b.iter()).any(|(a, b)| a.abs_diff(*b) > levels)).count()
}

/// Pixels in which one and the same surface may look different when it is cut into other triangles.
const TOLERANCE: usize = 64 * 48 / 100;

#[test]
fn a_motion_starts_as_the_picture_before_and_ends_as_the_one_after() {
    let small = Forest::new(4, 2, [1, 1]).unwrap().with_precision(3).unwrap();
    let worlds = [world(), World::new(small, 30.0, rough)];
    // Levels before and after; those of the small one are past the lattice.
    let cases = [(0, 3, 4), (0, 5, 6), (0, 9, 11), (0, 5, 4), (1, 4, 5), (1, 6, 7), (1, 3, 6), (1, 6, 5)];
    for (number, from, to) in cases {
        let world = &worlds[number];
        let camera = Camera { eye: world.place(0.5, -0.5, 1500.0), ..world.overhead([320, 240]) };
        let draw = |items: &[DrawItem]| picture(world, &camera, items, &PLAIN);
        let [before, after] =
            [from, to].map(|most| world.surfaces.keys().copied().filter(|d| d.level() < most).collect());
        let mut play = Play::new(world);
        play.step(&before, |_| false);
        // After a rest as many begin at once as ever may.
        play.frame += 2 * FRAMES;
        let mut cut = play.step(&after, |_| true);
        let at = |play: &Play<'_>, part: f64| {
            Moment::at((f64::from(play.frame) / f64::from(FRAMES) + part) * SECONDS)
        };
        let pictures = [&before, &after].map(|split| draw(&world.cut(split)));
        let changed = different(&pictures[0], &pictures[1], 3);
        let all_at_once = cut.waiting.is_empty();
        if all_at_once {
            let wrong = different(&draw(&play.items(&cut, at(&play, 0.0))), &pictures[0], 3);
            println!("{from} to {to}: {wrong} pixels of the first picture differ, of {changed} that changed");
            assert!(wrong <= TOLERANCE, "{from} to {to}: {wrong} pixels of the first picture");
        }
        while !cut.waiting.is_empty() {
            cut = play.step(&after, |_| true);
        }
        let [half, end] = [0.5, 1.0].map(|part| draw(&play.items(&cut, at(&play, part))));
        // One that has split is exactly as if it never moved; one that is to merge is where its parents are.
        let (levels, most) = if to > from { (0, 0) } else { (3, TOLERANCE) };
        let wrong = different(&end, &pictures[1], levels);
        println!("{from} to {to}: {wrong} pixels of the last picture differ");
        assert!(wrong <= most, "{from} to {to}: {wrong} pixels of the last picture");
        let [gone, left] = [&pictures[0], &pictures[1]].map(|picture| different(&half, picture, 3));
        println!("{from} to {to}: half way {gone} pixels differ from the first and {left} from the last");
        assert!(
            !all_at_once || changed < 1000 || (gone > changed / 20 && left > changed / 20),
            "{gone} {left} {changed}"
        );
    }
}

/// Triangles that appear are seen in some pixels, and those whose place they take in the others.
#[test]
fn irregular_triangles_appear_pixel_by_pixel() {
    let world = World::tin(Forest::new(6, 2, [2, 1]).unwrap(), 30.0, rough);
    let camera = Camera { eye: world.place(0.5, -0.5, 1500.0), ..world.overhead([320, 240]) };
    let draw = |items: &[DrawItem]| picture(&world, &camera, items, &PLAIN);
    let ask = cut::Ask {
        layer: &world.layer,
        encoding: Encoding::Tin,
        camera: &camera,
        exaggeration: 1.0,
        tolerance_pixels: 1.0,
        sight: sight::Sight::default(),
        seen: None,
        memory_bytes: usize::MAX,
        gpu: None,
    };
    let [low, high] = world.layer.heights.map(|h| (h / world.layer.quantum) as i32);
    let entry = |_| Some(Entry { error_metres: 1.0, low, high, bytes: 1 });
    for (from, to) in [(3, 4), (5, 6), (5, 4), (8, 7)] {
        let [before, after]: [HashSet<Diamond>; 2] =
            [from, to].map(|most| world.surfaces.keys().copied().filter(|d| d.level() < most).collect());
        let [first, last] = [&before, &after].map(|split| draw(&world.cut(split)));
        let changed = different(&first, &last, 3);
        let mut play = Play::new(&world);
        play.step(&before, |_| false);
        let cut = play.step(&after, |_| true);
        let at = |part: f64| {
            let now = Moment::at((f64::from(play.frame) / f64::from(FRAMES) + part) * SECONDS);
            draw(&cut::show(0, &ask, &cut::Ideal::default(), entry, &cut, now).items)
        };
        assert_eq!(different(&at(0.0), &first, 0), 0, "{from} to {to}: it begins as it was");
        assert_eq!(different(&at(1.0), &last, 0), 0, "{from} to {to}: it ends as it is to be");
        let half = at(0.5);
        let pixels = half.pixels.chunks(4).zip(first.pixels.chunks(4).zip(last.pixels.chunks(4)));
        let other = pixels.filter(|(half, (first, last))| half != first && half != last).count();
        let [gone, left] = [&first, &last].map(|picture| different(&half, picture, 3));
        println!(
            "{from} to {to}: of {changed} pixels half way {gone} have changed and {left} have not, {other} are new"
        );
        assert!(
            changed > 1000 && gone.abs_diff(left) < changed / 5,
            "{from} to {to}: {gone} {left} {changed}"
        );
        // Where a silhouette is of a part of the triangles, what is behind may be seen.
        assert!(other <= TOLERANCE, "{from} to {to}: {other}");
    }
}

#[test]
fn the_gpu_takes_records_as_they_are_and_drops_them_when_they_are_over() {
    let bytes: u64 = RECORD.iter().map(|a| a.format.size()).sum();
    assert_eq!((bytes, RECORD[0].offset), (size_of::<morph::Record>() as u64, 0));
    let world = world();
    let layers = std::slice::from_ref(&world.layer);
    let camera = world.overhead([64, 64]);
    let mut offscreen = offscreen(1, 1 << 30);
    let mut play = Play::new(&world);
    let roots: HashSet<Diamond> = world.layer.forest.root_diamonds().collect();
    let next = any_splits(&world.layer.forest, 1, 1.0).into_iter().filter(|d| d.level() < 3).collect();
    let mut draw = |play: &mut Play<'_>, wanted: &HashSet<Diamond>| {
        let cut = play.step(wanted, |_| true);
        let items = play.items(&cut, play.now());
        let moving = items.iter().filter(|item| item.moving.is_some()).count() as u64;
        (offscreen.draw(layers, &camera, &items, &PLAIN).unwrap(), moving)
    };
    assert_eq!(draw(&mut play, &roots).1, 0);
    let (first, moving) = draw(&mut play, &next);
    let (again, _) = draw(&mut play, &next);
    assert!(moving > 0 && first.uploaded_bytes > 0 && again.uploaded_bytes == 0);
    assert_eq!(again.gpu_bytes, first.gpu_bytes);
    for _ in 0..FRAMES {
        draw(&mut play, &next);
    }
    let (last, none) = draw(&mut play, &next);
    let records = (5 * 5 + 4 * 4) * size_of::<morph::Record>() as u64;
    assert_eq!((none, last.gpu_bytes), (0, first.gpu_bytes - moving * records));
}

/// So many begin as the time since the last frame has room for, and no more than ever may; at least one.
#[test]
fn short_frames_begin_few_motions() {
    let world = world();
    let all = any_splits(&world.layer.forest, 1, 1.0);
    let roots: HashSet<Diamond> = world.layer.forest.root_diamonds().collect();
    // Milliseconds of a frame, and how many of 16 begin in it.
    for (milliseconds, most) in [(500.0, 16), (20.1, 16), (10.0, 8), (5.0, 4), (0.1, 1), (0.0, 1)] {
        let mut play = Play::beginning(&world, 16);
        let mut seconds = 1.0;
        play.step_at(Moment::at(seconds), &roots, |_| true);
        let begun: Vec<usize> = (0..6)
            .map(|_| {
                let known: HashSet<Diamond> = play.morphs.moving().collect();
                seconds += milliseconds / 1e3;
                play.step_at(Moment::at(seconds), &all, |_| true);
                play.morphs.moving().filter(|d| !known.contains(d)).count()
            })
            .collect();
        // A few of them have nothing to move: they cost as much.
        let largest = begun.iter().max().copied().unwrap();
        assert!(largest <= most && largest + 1 >= most.div_ceil(2), "{milliseconds} ms: {begun:?} of {most}");
    }
}
