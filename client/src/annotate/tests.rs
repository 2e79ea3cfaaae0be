//! Annotations against the camera's own projection.

use super::scale_bar::Bar;
use super::*;
use crate::camera::FOV_Y;
use crate::render::{Annotations, Colours, Scale};
use crate::world::world;

fn camera(heading_degrees: f64, pitch_degrees: f64) -> Camera {
    let (heading, pitch) = (heading_degrees.to_radians(), pitch_degrees.to_radians());
    let ahead = DVec3::new(heading.sin() * pitch.cos(), heading.cos() * pitch.cos(), -pitch.sin());
    let target = DVec3::new(612_345.0, 4_512_345.0, 800.0);
    Camera { eye: target - 7000.0 * ahead, target, fov_y: FOV_Y, size: [1380, 768] }
}

/// Where a place is in the picture, in pixels.
fn pixel_of(camera: &Camera, place: DVec3) -> DVec2 {
    let clip = camera.clip_from_eye(1.0).project_point3((place - camera.eye).as_vec3());
    let size = DVec2::from(camera.size.map(f64::from));
    DVec2::new((f64::from(clip.x) + 1.0) / 2.0, (1.0 - f64::from(clip.y)) / 2.0) * size
}

fn subject<'a>(camera: &'a Camera, look: &'a Look) -> Subject<'a> {
    Subject { camera, look, layers: &[], imagery: None, globe: None, centre: Some(camera.target) }
}

#[test]
fn lengths_are_round_and_as_long_as_fits() {
    for (most, expected) in [
        (1.0, 1.0),
        (1.9, 1.0),
        (2.0, 2.0),
        (4.99, 2.0),
        (5.0, 5.0),
        (9.9, 5.0),
        (1234.0, 1000.0),
        (0.03, 0.02),
        (1e-3, 1e-3),
    ] {
        assert_eq!(value(round_down(most)), expected, "{most}");
    }
    for power in -6..=7 {
        assert_eq!(value(round_down(10f64.powi(power))), value((1, power)), "10^{power} is round itself");
    }
    for (length, text) in
        [(20_000.0, "20 km"), (500.0, "500 m"), (0.02, "0.02 m"), (12_340.0, "12.3 km"), (999.7, "1000 m")]
    {
        assert_eq!(metres(length), text);
    }
}

#[test]
fn the_bar_is_as_long_as_its_length_looks_in_the_middle() {
    let look = Look::default();
    for heading in [0.0, 77.0, 180.0, 301.0] {
        for pitch in [3.0, 35.0, 89.0] {
            let camera = camera(heading, pitch);
            let anchor = Anchor { place: camera.target, is_ground: true };
            let bar = Bar::new(&subject(&camera, &look), anchor, 300.0).unwrap();
            let [right, ..] = camera.axes();
            let half = right * value(bar.length) / 2.0;
            let [a, b] = [pixel_of(&camera, camera.target - half), pixel_of(&camera, camera.target + half)];
            assert!(((b - a).length() - bar.pixels).abs() < 0.01, "{a} {b} {bar:?}");
            assert!((a.y - b.y).abs() < 1e-2, "across the picture");
            assert!(bar.pixels <= 300.0 && bar.pixels > 300.0 / 2.6, "{bar:?}");
            assert!((bar.distance - 7000.0).abs() < 1e-3);
        }
    }
}

#[test]
fn the_bar_counts_metres_of_the_ground() {
    use diamantina_protocol::message::{Crs, Frame};
    let proj4 = Some("+proj=merc +a=6378137 +b=6378137 +lon_0=0 +nadgrids=@null".to_owned());
    let crs = Crs { name: String::new(), proj4, origin: [0.0; 2], per_metre: [1.0; 2] };
    let globe = Globe::of(&Frame { crs: Some(crs), vertical_unit: "metre".into() }).unwrap();
    let mut camera = camera(40.0, 50.0);
    // At 60 degrees of latitude.
    let by = DVec3::new(0.0, 8_399_738.0 - camera.target.y, 0.0);
    (camera.eye, camera.target) = (camera.eye + by, camera.target + by);
    let look = Look::default();
    let anchor = Anchor { place: camera.target, is_ground: true };
    let subject = Subject { globe: Some(&globe), ..subject(&camera, &look) };
    let bar = Bar::new(&subject, anchor, 300.0).unwrap();
    let frame_metres = bar.pixels * 7000.0 / camera.pixels_per_radian();
    assert!((frame_metres / value(bar.length) - 2.0).abs() < 0.01, "{bar:?}");
    // A place behind the eye has no scale.
    let behind = Anchor { place: camera.eye + (camera.eye - camera.target), is_ground: false };
    assert!(Bar::new(&subject, behind, 300.0).is_none());
}

#[test]
fn the_arrow_points_where_a_step_to_the_north_is_seen() {
    for heading in [0.0, 30.0, 90.0, 135.0, 180.0, 271.0] {
        for pitch in [15.0, 40.0, 70.0, 89.9] {
            let camera = camera(heading, pitch);
            let step = pixel_of(&camera, camera.target + DVec3::Y * 2.0)
                - pixel_of(&camera, camera.target - DVec3::Y * 2.0);
            let arrow = on_screen(&camera, DVec2::Y, 0.12);
            let apart = step.normalize().perp_dot(arrow.normalize()).asin().to_degrees();
            assert!(apart.abs() < 1.0 && step.dot(arrow) > 0.0, "{heading} {pitch}: {step} {arrow}");
        }
    }
    // Looking east, north is on the left; looking south, it is behind: down.
    let east = on_screen(&camera(90.0, 30.0), DVec2::Y, 0.12);
    assert!((east - DVec2::new(-1.0, 0.0)).length() < 1e-9, "{east}");
    let south = on_screen(&camera(180.0, 30.0), DVec2::Y, 0.12);
    assert!((south - DVec2::new(0.0, 0.5)).length() < 1e-9, "{south}");
    // Flat views have one, too.
    assert!([0.0, -4.0].iter().all(|pitch| on_screen(&camera(0.0, *pitch), DVec2::Y, 0.12).y < -0.1));
}

/// What is drawn of the arrow stays on its plate however low the eye, and the needle has a body.
#[test]
fn the_arrow_keeps_to_its_plate_and_its_letter_is_free() {
    let look =
        Look { annotations: Annotations { north_arrow: true, ..Annotations::default() }, ..Look::default() };
    let screen = Rect::from_min_size(Pos2::ZERO, vec2(1380.0, 768.0));
    for heading in (0..36).map(|tens| f64::from(tens) * 10.0) {
        for pitch in [-20.0, 0.0, 3.0, 20.0, 60.0, 89.0] {
            let context = egui::Context::default();
            let camera = camera(heading, pitch);
            let input = egui::RawInput { screen_rect: Some(screen), ..egui::RawInput::default() };
            let output = context.run_ui(input, |ui| {
                show(ui.painter(), ui.max_rect(), &subject(&camera, &look));
            });
            let shapes = &output.shapes;
            let plate = shapes.iter().find_map(|s| match &s.shape {
                egui::Shape::Rect(plate) => Some(plate.rect),
                _ => None,
            });
            let letter = shapes.iter().find_map(|s| match &s.shape {
                egui::Shape::Text(text) => Some(text.visual_bounding_rect()),
                _ => None,
            });
            let filled = shapes.iter().find_map(|s| match &s.shape {
                egui::Shape::Mesh(mesh) => Some(mesh.vertices.iter().map(|v| v.pos).collect::<Vec<_>>()),
                _ => None,
            });
            let (plate, letter, needle) = (plate.unwrap(), letter.unwrap(), filled.unwrap());
            let [a, b, c] = [needle[0], needle[1], needle[2]];
            let area = ((b - a).x * (c - a).y - (b - a).y * (c - a).x).abs() / 2.0;
            assert!(area > 25.0, "{heading} {pitch}: {area} square points");
            // The cross in the middle of the picture is not the arrow's.
            let is_here = |s: &&egui::epaint::ClippedShape| s.shape.visual_bounding_rect().intersects(plate);
            let lines = shapes.iter().filter(is_here).filter(|s| !matches!(s.shape, egui::Shape::Text(_)));
            let drawn = context.tessellate(lines.cloned().collect(), 1.0);
            for clipped in &drawn {
                let egui::epaint::Primitive::Mesh(mesh) = &clipped.primitive else { continue };
                let is_out = |v: &&egui::epaint::Vertex| !plate.expand(1.0).contains(v.pos);
                assert_eq!(mesh.vertices.iter().find(is_out), None, "{heading} {pitch}");
            }
            let is_in_letter = |corner: &Pos2| letter.expand(0.5).contains(*corner);
            assert!(!needle.iter().any(is_in_letter), "{heading} {pitch}: {needle:?} in {letter}");
            output.drop_without_applying_deltas();
        }
    }
}

#[test]
fn labels_are_round_and_stand_at_their_values() {
    let layer = |heights| Layer { heights, ..world()[0].layer.clone() };
    let look = Look { colours: Colours::Auto, ..Look::default() };
    for heights in [[-2153.0, 1599.0], [0.0, 4128.0], [12.3, 14.9], [-0.135, 0.125], [-900.0, -100.0]] {
        let scale = Scale::of(&look, &layer(heights));
        let labels = legend::labels(&scale, 190.0);
        assert!((3..=12).contains(&labels.len()), "{labels:?}");
        for (at, text) in &labels {
            let told: f64 = text.replace('−', "-").parse().unwrap();
            let [low, high] = heights;
            let value = low + (high - low) * f64::from(*at);
            assert!((told - value).abs() < 0.02 * (high - low), "{text} at {value}");
        }
        let mut places: Vec<f32> = labels.iter().map(|(at, _)| *at).collect();
        places.sort_by(f32::total_cmp);
        assert!(places.windows(2).all(|pair| (pair[1] - pair[0]) * 190.0 > 14.0), "{places:?}");
    }
    let flat = Scale::of(&look, &layer([7.0, 7.0]));
    assert_eq!(legend::labels(&flat, 190.0).len(), 1);
}

/// Texts of a frame with these annotations.
fn texts(annotations: Annotations, layers: &[Layer], look: Look) -> Vec<String> {
    texts_over(None, annotations, layers, look)
}

/// The same where imagery of this name lies on the ground.
fn texts_over(imagery: Option<&str>, annotations: Annotations, layers: &[Layer], look: Look) -> Vec<String> {
    let context = egui::Context::default();
    let camera = camera(20.0, 40.0);
    let look = Look { annotations, ..look };
    let input = egui::RawInput {
        screen_rect: Some(Rect::from_min_size(Pos2::ZERO, vec2(1380.0, 768.0))),
        ..egui::RawInput::default()
    };
    let output = context.run_ui(input, |ui| {
        show(ui.painter(), ui.max_rect(), &Subject { layers, imagery, ..subject(&camera, &look) });
    });
    let texts = output.shapes.iter().filter_map(|clipped| match &clipped.shape {
        egui::Shape::Text(text) => {
            let rect = text.visual_bounding_rect();
            assert!(Rect::from_min_size(Pos2::ZERO, vec2(1380.0, 768.0)).contains_rect(rect), "{rect}");
            Some(text.galley.text().to_owned())
        }
        _ => None,
    });
    let texts = texts.collect();
    output.drop_without_applying_deltas();
    texts
}

#[test]
fn what_is_written_is_what_was_asked_for() {
    let layers = [world()[0].layer.clone()];
    let all = texts(Annotations::ALL, &layers, Look::default());
    for text in ["N", "0", "Height [m]", "at the cross (7 km away)"] {
        assert!(all.iter().any(|found| found == text), "{text} in {all:?}");
    }
    assert!(all.contains(&layers[0].name));
    assert!(texts(Annotations::default(), &layers, Look::default()).is_empty());
    let north = Annotations { north_arrow: true, ..Annotations::default() };
    assert_eq!(texts(north, &layers, Look::default()), ["N"]);
    let legend = Annotations { legend: true, ..Annotations::default() };
    let photo = texts_over(Some("photo"), legend, &layers, Look::default());
    assert!(photo.iter().any(|text| text == "but not under photo"), "{photo:?}");
    let slope = texts(legend, &layers, Look { colours: Colours::Slope, ..Look::default() }.truthful());
    for text in ["Slope [°]", "60", "lit from 315°, 45° high"] {
        assert!(slope.iter().any(|found| found == text), "{text} in {slope:?}");
    }
    let stretched = Look { exaggeration: 3.0, ..Look::default() };
    let bar = texts(Annotations { scale_bar: true, ..Annotations::default() }, &layers, stretched);
    assert!(bar.iter().any(|text| text.ends_with("heights × 3")), "{bar:?}");
}

/// In a finished picture: the bar of the legend shows the colours of the ramp in order, and only plates hide anything.
#[test]
fn a_picture_without_a_window_has_them_too() {
    use crate::render::{self, Offscreen, Shading};
    let layers = [Layer { heights: [100.0, 900.0], ..world()[0].layer.clone() }];
    for background in [[1.0, 1.0, 1.0, 1.0], [0.0, 0.0, 0.0, 1.0]] {
        let look = Look { colours: Colours::Viridis, shading: Shading::Unlit, ..Look::default() };
        let look = Look { background: Background::Colour(background), annotations: Annotations::ALL, ..look };
        let camera = Camera { size: [640, 480], ..camera(20.0, 40.0) };
        let mut offscreen = Offscreen::new(&render::Options::default()).unwrap_or_else(|e| panic!("{e}"));
        offscreen.draw(&[], &camera, &[], &look).unwrap();
        let bare = offscreen.read().unwrap();
        offscreen.draw_over(pixels_per_point(camera.size), |painter, area| {
            show(painter, area, &Subject { layers: &layers, ..subject(&camera, &look) });
        });
        let picture = offscreen.read().unwrap();
        let changed = (0..480).flat_map(|y| (0..640).map(move |x| [x, y]));
        let changed = changed.filter(|p| picture.pixel(*p) != bare.pixel(*p)).count();
        assert!((3000..100_000).contains(&changed), "{changed} pixels");
        assert_eq!(picture.pixel([200, 100]), bare.pixel([200, 100]));
        let scale = Scale::of(&look, &layers[0]);
        let values = (0..=800).rev().map(|i| 100.0 + f64::from(i));
        let values: std::collections::HashMap<[u8; 3], f64> = values.map(|v| (scale.colour(v), v)).collect();
        let value_of = |[r, g, b, _]: [u8; 4]| values.get(&[r, g, b]).copied();
        let column = |x: u32| -> Vec<f64> {
            (0..480).filter_map(|y| picture.pixel([x, y]).and_then(value_of)).collect()
        };
        let best = (480..640).map(column).max_by_key(Vec::len).unwrap();
        assert!(best.len() > 60 && best.is_sorted_by(|a, b| a >= b), "{best:?}");
        assert!(best[0] > 880.0 && best[best.len() - 1] < 120.0, "{best:?}");
    }
}
