//! Water that changes with time: built of many files, drawn at a time, and refused.

use crate::hostile::{assert_failed, client, server};
use crate::http::{block, get};
use crate::layers::{pixels, write_asc};
use crate::world::serve;
use std::path::Path;

/// Samples along the sides of ground and water.
const SIDE: u32 = 130;

/// Metres between them.
const CELL: f64 = 10.0;

/// Ground that rises to the east, and three files of a wave that runs there: 1, 2 and 10, so that an order by letters would
/// be another.
fn write_files(folder: &Path) {
    let size = [SIDE; 2];
    let ground = |i: u32, j: u32| Some(-30.0 + 0.4 * f64::from(i) + (f64::from(j) / 9.0).sin() * 3.0);
    write_asc(&folder.join("bed.asc"), size, [0.0; 2], CELL, ground);
    for (number, crest) in [(1, 15.0), (2, 40.0), (10, 65.0)] {
        write_asc(&folder.join(format!("wave_{number}.asc")), size, [0.0; 2], CELL, |i, j| {
            let from_crest = (f64::from(i) - crest) / 6.0;
            let height = 9.0 * (-from_crest * from_crest).exp() * (1.0 + f64::from(j) / 200.0);
            Some(height).filter(|height| ground(i, j).is_some_and(|ground| ground < *height))
        });
    }
}

#[test]
fn each_step_of_a_series_is_the_picture_of_a_scene_of_that_step_alone() {
    let scratch = tempfile::tempdir().unwrap();
    let folder = scratch.path();
    write_files(folder);
    let build = |name: &str, water: &str, more: &str| {
        let command =
            format!("build {{}}/bed.asc --layer sea=water:{{}}/{water} -o {{}}/{name} --scene {name} {more}");
        let ended = server(folder, &command);
        assert_eq!(ended.code, Some(0), "{ended:?}");
        ended.out
    };
    let told = build("waves", "wave_*.asc", "--step-seconds 10");
    assert!(told.contains("series sea: 3 steps of 10 s") && !told.contains("layer sea.1"), "{told}");
    build("last", "wave_10.asc", "");
    let text = |name: &str| std::fs::read_to_string(folder.join(name).join("scene.json")).unwrap();
    assert!(!text("last").contains("series"), "a scene without one says nothing of it");
    let served = serve(&["waves", "last"].map(|name| folder.join(name)));
    block(async {
        let scene = get(&served.scene("waves")).await.json();
        let names = ["sea.0", "sea.1", "sea.2"];
        let series = serde_json::json!([{"name": "sea", "layers": names, "step_seconds": 10.0}]);
        assert_eq!(scene["series"], series);
        assert!(get(&served.scene("last")).await.json().get("series").is_none());
        // Each is served by its own name: the crest is where it is at that time.
        for (step, crest) in [(0, 15.0), (1, 40.0), (2, 65.0)] {
            let at = format!("height?x={}&y=0", crest * CELL);
            let answer = get(&format!("{}/sea.{step}/{at}", served.scene("waves"))).await.json();
            assert!((answer["height"].as_f64().unwrap() - 9.0).abs() < 0.01, "step {step}: {answer}");
        }
    });
    let draw = |scene: &str, options: &str| {
        let view = "--eye 650,-700,500 --target 600,500,0 --size 300x200 --no-antialias --json -";
        let command = format!("render {} -o {{}}/picture.png {view} {options}", served.scene(scene));
        let ended = client(folder, &command);
        assert_eq!(ended.code, Some(0), "{ended:?}");
        let report: serde_json::Value = serde_json::from_str(&ended.out).unwrap();
        (pixels(&folder.join("picture.png")), report)
    };
    let (alone, of_alone) = draw("last", "");
    let (first, of_first) = draw("waves", "");
    let (last, of_last) = draw("waves", "--time 25");
    assert!(last == alone, "the step that began at 20 s is the file with the highest number");
    let other = first.chunks(4).zip(last.chunks(4)).filter(|(a, b)| a != b).count();
    assert!(other > 1000, "{other} pixels differ");
    let times = serde_json::json!([of_first["time_seconds"], of_last["time_seconds"]]);
    assert_eq!(times, serde_json::json!([0.0, 25.0]));
    assert!(of_alone["time_seconds"].is_null());
    // On a flight time goes on, and each frame waits for what it shows.
    let fly = format!("fly {} --frames 5 --size 160x90 --settle 30 --play 2 --csv -", served.scene("waves"));
    let flown = client(folder, &format!("{fly} --path {{}}/path.json"));
    assert_failed(&flown, 1, &["path.json"], "no such path");
    let keys = r#"{"keys":[{"seconds":0,"eye":[650,-700,500],"target":[600,500,0]},{"seconds":20,"eye":[650,-600,500],"target":[600,500,0]}]}"#;
    std::fs::write(folder.join("path.json"), keys).unwrap();
    let flown = client(folder, &format!("{fly} --path {{}}/path.json"));
    assert_eq!(flown.code, Some(0), "{flown:?}");
    let mut lines = flown.out.lines().map(|line| line.split(',').collect::<Vec<_>>());
    let heading = lines.next().unwrap();
    let of = |name: &str| heading.iter().position(|found| *found == name).unwrap();
    let (time, late, complete) = (of("time_seconds"), of("late"), of("complete"));
    let found: Vec<_> =
        lines.map(|line| (line[time].to_owned(), line[late].to_owned(), line[complete].to_owned())).collect();
    let expected = ["0.0000", "10.0000", "20.0000", "20.0000", "20.0000"];
    let expected: Vec<_> = expected.map(|time| (time.to_owned(), "0".to_owned(), "true".to_owned())).into();
    assert_eq!(found, expected, "it ends with the last step");
    for (command, words) in [
        (format!("render {} -o {{}}/no.png --time 31", served.scene("waves")), &["--time 31", "0 to 30"][..]),
        (format!("render {} -o {{}}/no.png --time -1", served.scene("waves")), &["--time -1", "0 to 30"]),
        (format!("render {} -o {{}}/no.png --time 1", served.scene("last")), &["'last'", "leave --time out"]),
        (
            format!("render {} -o {{}}/no.png --layer sea.1", served.scene("waves")),
            &["'sea.1'", "terrain, sea"],
        ),
        (format!("fly {} --play nan", served.scene("waves")), &["--play NaN", "a number"]),
    ] {
        assert_failed(&client(folder, &command), 2, words, &command);
    }
}

#[test]
fn files_that_make_no_series_are_refused_with_what_to_do() {
    let scratch = tempfile::tempdir().unwrap();
    let folder = scratch.path();
    write_files(folder);
    write_asc(&folder.join("wave_7.asc"), [SIDE, SIDE - 1], [0.0, CELL], CELL, |_, _| Some(1.0));
    write_asc(&folder.join("dry_0.asc"), [SIDE; 2], [0.0; 2], CELL, |_, _| Some(1.0));
    write_asc(&folder.join("dry_1.asc"), [SIDE; 2], [0.0; 2], CELL, |_, _| None);
    for (args, code, words) in [
        ("--layer sea=water:{}/none_*.asc", 2, &["--layer sea", "none_*.asc", "found none"][..]),
        (
            "--layer sea=water:{}/wave_*.asc",
            2,
            &[
                "--layer sea",
                "wave_7.asc",
                "expected 130 x 130 samples",
                "wave_1.asc",
                "130 x 129",
                "one extent",
            ],
        ),
        ("--layer sea=water:{}/dry_*.asc", 1, &["dry_1.asc", "layer 'sea.1'", "nodata"]),
        ("--layer sea=terrain:{}/wave_*.asc", 2, &["wave_*.asc", "patterns are for water"]),
        (
            "--layer sea=water:{}/dry_?.asc --layer sea=water:level=0",
            2,
            &["'sea' is a series", "another name"],
        ),
        ("--layer sea=water:{}/dry_0.asc --step-seconds 0", 2, &["--step-seconds 0", "expected seconds"]),
    ] {
        let ended = server(folder, &format!("build {{}}/bed.asc {args} -o {{}}/store"));
        assert_failed(&ended, code, words, args);
        assert!(!folder.join("store/scene.json").exists(), "{args}");
    }
    // One file that matches is a series of one step.
    let one = server(folder, "build {}/bed.asc --layer sea=water:{}/wave_1?.asc -o {}/store");
    assert!(one.code == Some(0) && one.out.contains("series sea: 1 step of 1 s"), "{one:?}");
}
