//! The panel: whether it is open, what it says, and what it writes over the picture.

use super::super::panel::top;
use super::*;

#[test]
fn the_panel_comes_and_goes_and_leaves_the_keys_alone() {
    let mut hand = Hand::new(Some(looking_down()));
    for is_open in [false, true] {
        hand.key(Key::Tab, true);
        hand.key(Key::Tab, false);
        assert_eq!(hand.viewer.panel_is_open, is_open);
        let before = hand.camera();
        hand.key(Key::W, true);
        (0..5).for_each(|_| hand.frame(&[]));
        hand.key(Key::W, false);
        assert!(hand.camera().eye != before.eye, "keys fly");
    }
}

#[test]
fn the_panel_has_a_button_and_is_closed_where_there_is_no_room() {
    let mut hand = Hand::new(Some(looking_down()));
    assert!(hand.viewer.panel_is_open);
    // In its upper right corner.
    hand.click(pos2(972.0, 22.0));
    assert!(!hand.viewer.panel_is_open);
    hand.frame(&[]);
    hand.click(pos2(976.0, 20.0));
    assert!(hand.viewer.panel_is_open && hand.viewer.marks().is_empty());

    let mut hand = Hand::new(Some(looking_down()));
    hand.points = vec2(390.0, 700.0);
    hand.frame(&[]);
    assert!(!hand.viewer.panel_is_open);
}

#[test]
fn slow_frames_are_told_and_messages_go() {
    let mut hand = Hand::new(Some(looking_down()));
    hand.viewer.tell("saved");
    // It moves as long as the key is held, so each frame asks for the next.
    hand.key(Key::W, true);
    (0..4).for_each(|_| hand.frame_after(0.5, Modifiers::NONE, &[]));
    let rate = hand.viewer.history.rate().unwrap();
    assert!((rate - 2.0).abs() < 0.01, "{rate} frames a second");
    assert!(hand.viewer.message.is_some());
    hand.key(Key::W, false);
    hand.settle();
    // After a rest the time since the last frame is not what a frame takes, nor does anything jump.
    let before = hand.camera();
    hand.frame_after(MESSAGE_SECONDS, Modifiers::NONE, &[]);
    hand.frame(&[]);
    assert!(hand.viewer.history.rate().unwrap() < 100.0);
    assert_eq!(hand.camera(), before);
}

#[test]
fn water_plays_in_time_from_the_panel_and_its_address_tells_when() {
    use crate::world::{BEFORE_WAVES, WAVES};
    let mut hand = Hand::of(BEFORE_WAVES + WAVES, Some(looking_down()));
    let is_drawn = |hand: &Hand, step: usize| {
        let steps =
            hand.viewer.items().into_iter().map(|item| item.layer).filter(|layer| *layer >= BEFORE_WAVES);
        steps.collect::<std::collections::HashSet<_>>() == [BEFORE_WAVES + step].into()
    };
    assert!(is_drawn(&hand, 0));
    assert!(hand.viewer.address().ends_with(",0.000"), "{}", hand.viewer.address());
    // One box for the series, and what there is to press; the panel is longer than this window.
    let written = texts(&mut hand, true);
    assert!(find(&written, "waves").is_some() && find(&written, "waves.1").is_none(), "{written:?}");
    let requests = hand.viewer.frame().stats.traffic.requests;
    for _ in 0..20 {
        hand.frame(&[]);
    }
    assert_eq!(
        hand.viewer.frame().stats.traffic.requests,
        requests,
        "nothing is fetched ahead while time stands"
    );
    // Space plays. Ten times as fast, ten seconds take sixty frames.
    hand.viewer.player.speed = 10.0;
    hand.key(Key::Space, true);
    assert!(hand.viewer.player().plays);
    let until = Instant::now() + Duration::from_secs(60);
    let mut seen = vec![0];
    while hand.viewer.player().plays {
        hand.frame(&[]);
        let step = hand.viewer.terrain().step_drawn(0).unwrap();
        assert!(is_drawn(&hand, step), "one step, whole, in every frame");
        if seen.last() != Some(&step) {
            assert!(hand.viewer.frame().complete, "time waits for what it shows");
            seen.push(step);
        }
        assert!(Instant::now() < until, "{:?}", hand.viewer.player());
        std::thread::sleep(Duration::from_millis(1));
    }
    assert_eq!(seen, [0, 1, 2, 3], "each step is seen, in order");
    assert!(hand.viewer.address().ends_with(",30.000"), "{}", hand.viewer.address());
    // An address tells when, too, and so does a bookmark.
    hand.viewer.keep();
    let kept = hand.viewer.bookmarks()[0].view.clone();
    assert!(
        kept.ends_with(",30.000")
            && bookmarks::read(&format!(r#"[{{"name":"a","view":"{kept}"}}]"#)).len() == 1
    );
    let view = hand.viewer.view();
    let earlier = format!("{},10.5", view.rsplit_once(',').unwrap().0);
    assert!(hand.viewer.go_to(&earlier));
    hand.settle();
    assert!(is_drawn(&hand, 1) && hand.viewer.player().seconds == 10.5);
    assert!(!hand.viewer.go_to("1,2,3"));
    let time = |view: &str| View::parse(view, SIZE).unwrap().seconds;
    assert_eq!((time("1,2,3,4,5"), time("1,2,3,4,5,-6"), time("1,2,3,4,5, 6")), (None, None, Some(6.0)));
}

#[test]
fn the_panel_has_a_clock_where_water_changes_with_time_and_nowhere_else() {
    use crate::world::{BEFORE_WAVES, WAVES};
    // The clock alone, so that it lies within the window; what is written in it.
    let clock = |hand: &mut Hand, events: &[Event]| -> Vec<(String, Pos2)> {
        let size = vec2(SIZE[0] as f32, SIZE[1] as f32);
        let screen_rect = Some(Rect::from_min_size(Pos2::ZERO, size));
        hand.seconds += 1.0 / 60.0;
        let (time, events) = (Some(hand.seconds), events.to_vec());
        let input = RawInput { screen_rect, time, events, focused: true, ..RawInput::default() };
        let viewer = &mut hand.viewer;
        let output = hand.context.run_ui(input, |ui| time::show(viewer, ui));
        texts_of(output)
    };
    let press = |hand: &mut Hand, text: &str| {
        let pos = find(&clock(hand, &[]), text).unwrap() + vec2(4.0, 6.0);
        let button = |pressed| Event::PointerButton {
            pos,
            button: PointerButton::Primary,
            pressed,
            modifiers: Modifiers::NONE,
        };
        for event in [Event::PointerMoved(pos), button(true), button(false)] {
            clock(hand, &[event]);
        }
    };
    let mut still = Hand::new(Some(looking_down()));
    assert!(clock(&mut still, &[]).is_empty());
    assert!(!still.viewer.address().ends_with(",0.000"), "{}", still.viewer.address());
    let mut hand = Hand::of(BEFORE_WAVES + WAVES, Some(looking_down()));
    assert!(find(&clock(&mut hand, &[]), "waves: step 0 of 0 to 3").is_some());
    press(&mut hand, "+1");
    press(&mut hand, "+1");
    assert_eq!(hand.viewer.player().seconds, 20.0);
    hand.frame(&[]);
    let late = clock(&mut hand, &[]);
    assert!(find(&late, "waves: step 0 until 2 is there").is_some(), "{late:?}");
    hand.settle();
    press(&mut hand, "-1");
    hand.settle();
    assert!(find(&clock(&mut hand, &[]), "waves: step 1 of 0 to 3").is_some());
    press(&mut hand, "Play");
    press(&mut hand, "loop");
    assert!(hand.viewer.player().plays && hand.viewer.player().is_round);
    assert!(find(&clock(&mut hand, &[]), "Pause").is_some());
    // The slider itself: to its left end.
    let at = find(&clock(&mut hand, &[]), "time [s]").unwrap();
    press(&mut hand, "Pause");
    assert!(!hand.viewer.player().plays);
    let start = pos2(10.0, at.y + 6.0);
    let button = |pressed| Event::PointerButton {
        pos: start,
        button: PointerButton::Primary,
        pressed,
        modifiers: Modifiers::NONE,
    };
    for event in [Event::PointerMoved(start), button(true), button(false)] {
        clock(&mut hand, &[event]);
    }
    assert!(hand.viewer.player().seconds < 5.0, "{}", hand.viewer.player().seconds);
}

#[test]
fn the_panel_writes_over_the_picture() {
    let mut hand = Hand::new(Some(looking_down()));
    assert!(find(&texts(&mut hand, true), "Height [m]").is_none());
    hand.viewer.look.annotations = crate::render::Annotations::ALL;
    let beside = texts(&mut hand, true);
    let legend = find(&beside, "Height [m]").unwrap();
    assert!(find(&beside, "N").is_some() && find(&beside, "View").unwrap().x > legend.x, "left of the panel");
    // In a picture there is no panel, and it goes to the side.
    let alone = texts(&mut hand, false);
    assert!(find(&alone, "Height [m]").unwrap().x > legend.x && find(&alone, "View").is_none());
    assert!(alone.iter().any(|(text, _)| text.starts_with("at the cross (") && !text.contains("no ground")));
}

#[test]
fn a_few_huge_values_leave_a_plot_readable() {
    let mut values: std::collections::VecDeque<f32> =
        (0..200).map(|i| 1.0 + (i % 10) as f32 / 10.0).collect();
    assert_eq!(top(&values), 1.9);
    values.extend([f32::INFINITY, 9000.0, 8000.0, 7000.0]);
    assert!(top(&values) < 3.0, "{}", top(&values));
    assert_eq!(top(&[0.0, 0.0, 5.0].into()), 5.0);
    assert_eq!(top(&std::collections::VecDeque::new()), 0.0);
}
