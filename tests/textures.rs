//! Imagery on the ground, from picture files to pixels on the screen.

use crate::hostile::{assert_failed, client, end, server, start, words};
use crate::http::{block, get};
use crate::world::{programs, serve};
use diamantina_client::camera::{Camera, FOV_Y};
use diamantina_client::headless;
use diamantina_client::picture::Picture;
use diamantina_client::render::{self, Background, Imagery as Shown, Look, Offscreen};
use diamantina_client::terrain::{self, Imagery, Terrain};
use diamantina_client::texture::Coding;
use diamantina_protocol::message;
use diamantina_protocol::texture::{Coverage, INNER, Tile, coverage_bytes};
use diamantina_server::store::Store;
use glam::DVec3;
use reqwest::header::{CONTENT_TYPE, ETAG};
use std::fs::File;
use std::io::BufWriter;
use std::path::Path;
use std::time::Duration;
use tempfile::TempDir;
use tiff::encoder::{TiffEncoder, colortype};

/// Texels of the image, and how large they are in metres: 3 x 3 tiles of the finest level, two to four of them at the rims.
const SIZE: [u32; 2] = [700, 600];
const TEXEL: f64 = 2.0;

/// The corner of the image, and of the ground, which reaches beyond it.
const CORNER: [f64; 2] = [400_100.0, 7_500_150.0];
const GROUND: [f64; 2] = [400_000.0, 7_500_000.0];
const HEIGHT: f64 = 100.0;

/// Where the image is transparent: around here, within so many metres.
const HOLE: ([f64; 2], f64) = ([400_900.0, 7_500_900.0], 150.0);

/// The colour of the image at a place, in metres from its corner: no two places have the same, and nothing is abrupt.
fn colour([x, y]: [f64; 2]) -> [f64; 3] {
    let [u, v] = [x / (f64::from(SIZE[0]) * TEXEL), y / (f64::from(SIZE[1]) * TEXEL)];
    [40.0 + 160.0 * u, 40.0 + 160.0 * v, 100.0 + 60.0 * (6.0 * (u + v)).sin()]
}

fn is_hole(x: f64, y: f64) -> bool {
    (x - HOLE.0[0]).hypot(y - HOLE.0[1]) < HOLE.1
}

/// Texels of red, green, blue and opacity, rows from the north.
fn texels() -> Vec<[u8; 4]> {
    let [width, height] = SIZE;
    let texel = |row: u32, column: u32| {
        let at = [f64::from(column), f64::from(height - 1 - row)].map(|i| (i + 0.5) * TEXEL);
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "colours are bytes")]
        let [r, g, b] = colour(at).map(|c| c.round() as u8);
        let opacity = if is_hole(CORNER[0] + at[0], CORNER[1] + at[1]) { 0 } else { 255 };
        [r, g, b, opacity]
    };
    (0..height).flat_map(|row| (0..width).map(move |column| texel(row, column))).collect()
}

fn write_png(path: &Path) {
    let mut encoder = png::Encoder::new(BufWriter::new(File::create(path).unwrap()), SIZE[0], SIZE[1]);
    encoder.set_color(png::ColorType::Rgba);
    encoder.write_header().unwrap().write_image_data(texels().as_flattened()).unwrap();
    let [x, y] = [CORNER[0] + TEXEL / 2.0, CORNER[1] + (f64::from(SIZE[1]) - 0.5) * TEXEL];
    std::fs::write(path.with_extension("pgw"), format!("{TEXEL}\n0\n0\n-{TEXEL}\n{x}\n{y}\n")).unwrap();
}

/// The same without a hole, as a GeoTIFF of its own place.
fn write_tiff(path: &Path) {
    let mut encoder = TiffEncoder::new(BufWriter::new(File::create(path).unwrap())).unwrap();
    let mut image = encoder.new_image::<colortype::RGB8>(SIZE[0], SIZE[1]).unwrap();
    let (scale, tie): (&[f64], &[f64]) =
        (&[TEXEL, TEXEL, 0.0], &[0.0, 0.0, 0.0, CORNER[0], CORNER[1] + f64::from(SIZE[1]) * TEXEL, 0.0]);
    let keys: &[u16] = &[1, 1, 0, 3, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, 32723];
    let tags = image.encoder();
    tags.write_tag(tiff::tags::Tag::ModelPixelScaleTag, scale).unwrap();
    tags.write_tag(tiff::tags::Tag::ModelTiepointTag, tie).unwrap();
    tags.write_tag(tiff::tags::Tag::GeoKeyDirectoryTag, keys).unwrap();
    let colours: Vec<u8> = texels().iter().flat_map(|[r, g, b, _]| [*r, *g, *b]).collect();
    image.write_data(&colours).unwrap();
}

/// Flat ground of 200 x 200 samples, and the image as PNG and as TIFF.
fn scratch() -> TempDir {
    let scratch = tempfile::tempdir().unwrap();
    let row = "100 ".repeat(200);
    let text = format!(
        "ncols 200\nnrows 200\nxllcenter {}\nyllcenter {}\ncellsize 10\n{}",
        GROUND[0],
        GROUND[1],
        format!("{row}\n").repeat(200)
    );
    std::fs::write(scratch.path().join("dem.asc"), text).unwrap();
    write_png(&scratch.path().join("photo.png"));
    write_tiff(&scratch.path().join("photo.tif"));
    scratch
}

fn build(scratch: &TempDir, options: &str) {
    let command = format!("build {{}}/dem.asc --assume-crs EPSG:32723 --scene world -o {{}}/store {options}");
    let ended = server(scratch.path(), &command);
    assert_eq!(ended.code, Some(0), "{ended:?}");
}

/// The ground that a pixel of the middle of the picture's plane shows.
fn ground(camera: &Camera, [x, y]: [u32; 2]) -> Option<[f64; 2]> {
    let [right, up, backward] = camera.axes();
    let [width, height] = camera.size.map(f64::from);
    let tan = (camera.fov_y / 2.0).tan();
    let across = ((f64::from(x) + 0.5) / width * 2.0 - 1.0) * tan * width / height;
    let along = (1.0 - (f64::from(y) + 0.5) / height * 2.0) * tan;
    let ray = right * across + up * along - backward;
    (ray.z < 0.0).then(|| {
        let p = camera.eye + ray * ((HEIGHT - camera.eye.z) / ray.z);
        [p.x, p.y]
    })
}

/// Imagery alone: no haze, no light but what the picture has.
fn bare() -> Look {
    let background = Background::Colour([1.0, 0.0, 1.0, 1.0]);
    Look { background, haze: 0.0, imagery: Shown { light: 0.0, opacity: 1.0 }, ..Look::default() }
}

fn draw(url: &str, camera: &Camera, imagery: Imagery) -> Picture {
    draw_as(url, camera, imagery, Coding::Plain)
}

fn draw_as(url: &str, camera: &Camera, imagery: Imagery, texture_coding: Coding) -> Picture {
    let options = terrain::Options { imagery, texture_coding, ..terrain::Options::default() };
    let mut terrain = Terrain::open(url, options).unwrap();
    let options = render::Options { samples: 1, ..render::Options::default() };
    let drawn = headless::picture(&mut terrain, camera, &bare(), &options, Duration::from_secs(60));
    let (picture, report) = drawn.unwrap();
    assert!(report.complete, "{report:?}");
    picture
}

fn pixel(picture: &Picture, [x, y]: [u32; 2]) -> [u8; 3] {
    let at = 4 * (y * picture.size[0] + x) as usize;
    [picture.pixels[at], picture.pixels[at + 1], picture.pixels[at + 2]]
}

fn views() -> [Camera; 4] {
    let centre = DVec3::new(400_800.0, 7_500_750.0, HEIGHT);
    let camera = |eye: DVec3, target: DVec3| Camera { eye, target, fov_y: FOV_Y, size: [400, 300] };
    // Where four tiles of the finest level meet.
    let tiles =
        DVec3::new(CORNER[0] + f64::from(INNER) * TEXEL, CORNER[1] + f64::from(INNER) * TEXEL, HEIGHT);
    [
        camera(centre + DVec3::new(0.0, -1.0, 2200.0), centre),
        camera(tiles + DVec3::new(0.0, -1.0, 250.0), tiles),
        camera(tiles + DVec3::new(-500.0, -400.0, 160.0), tiles),
        camera(centre + DVec3::new(0.0, -1.0, 5000.0), centre),
    ]
}

#[test]
fn every_pixel_shows_the_image_where_it_lies_without_seams() {
    let scratch = scratch();
    build(&scratch, "--layer photo=texture:{}/photo.png --texture-quality 95");
    let served = serve(&[scratch.path().join("store")]);
    let url = served.scene("world");
    for (number, camera) in views().iter().enumerate() {
        let whole = draw(&url, camera, Imagery::First);
        let plain = draw(&url, camera, Imagery::None);
        let in_blocks = (number == 1).then(|| draw_as(&url, camera, Imagery::First, Coding::Blocks));
        let (mut seen, mut largest, mut outside) = (0, 0.0f64, 0);
        for at in (0..300).flat_map(|y| (0..400).map(move |x| [x, y])) {
            let Some([x, y]) = ground(camera, at) else { continue };
            let place = [x - CORNER[0], y - CORNER[1]];
            // As wide as what is mixed at an edge: a few pixels of this view.
            let rim = 8.0 * TEXEL.max((camera.eye - DVec3::new(x, y, HEIGHT)).length() / 200.0);
            let inside = |margin: f64| {
                (0..2).all(|i| place[i] > margin && place[i] < f64::from(SIZE[i]) * TEXEL - margin)
            };
            let from_hole = (x - HOLE.0[0]).hypot(y - HOLE.0[1]) - HOLE.1;
            if inside(rim) && from_hole > rim {
                let found = pixel(&whole, at).map(f64::from);
                let expected = colour(place);
                let off =
                    |found: [f64; 3]| (0..3).map(|i| (found[i] - expected[i]).abs()).fold(0.0, f64::max);
                if let Some(picture) = &in_blocks {
                    let found = pixel(picture, at).map(f64::from);
                    assert!(off(found) <= 12.0, "in blocks, {at:?}: {found:?}, expected {expected:?}");
                }
                let off = off(found);
                largest = largest.max(off);
                // From far a pixel shows tens of metres, over which colours change.
                let limit = if number == 3 { 12.0 } else { 6.0 };
                assert!(off <= limit, "view {number}, pixel {at:?}: {found:?}, expected {expected:?}");
                seen += 1;
            } else if !inside(-rim) || from_hole < -rim {
                assert_eq!(pixel(&whole, at), pixel(&plain, at), "view {number}, pixel {at:?} is outside");
                outside += 1;
            }
        }
        if let Some(picture) = &in_blocks {
            let reads_blocks = Offscreen::new(&render::Options::default()).unwrap().reads_blocks();
            assert_eq!(
                picture.pixels != whole.pixels,
                reads_blocks,
                "not in blocks after all, or drawn without"
            );
        }
        println!("view {number}: {seen} pixels of the image, at most {largest:.1} off; {outside} outside");
        assert!(seen > [10_000, 80_000, 20_000, 1000][number], "view {number}: {seen}");
        assert!(number == 1 || outside > 500, "view {number}: {outside}");
    }
}

#[test]
fn a_texture_is_the_same_from_png_and_tiff_and_for_any_number_of_threads() {
    let scratch = scratch();
    let version = |options: &str| {
        build(&scratch, options);
        Store::open(&scratch.path().join("store")).unwrap().scene().clone()
    };
    // Lossless: the tiles are the image itself.
    let one = version("--layer photo=texture:{}/photo.tif --texture-quality 100 --threads 1");
    let two = version("--layer photo=texture:{}/photo.tif --texture-quality 100 --threads 2");
    assert_eq!(one, two);
    let inspected = server(scratch.path(), "inspect {}/store --verify");
    assert!(
        inspected.out.contains("texture photo: 700 x 600 texels of 2.000 x 2.000 m in 3 levels"),
        "{inspected:?}"
    );
    assert!(inspected.out.contains("verified: every blob"), "{inspected:?}");
    let png = version("--layer photo=texture:{}/photo.png");
    let [a, b] = [&one.textures[0], &png.textures[0]];
    assert_eq!((a.origin, a.texel, a.size, a.resampled), (b.origin, b.texel, b.size, b.resampled));
    assert_eq!((a.origin, a.size, a.resampled), (CORNER, SIZE, false));
    assert!(a.bytes > 2 * b.bytes, "{} {}", a.bytes, b.bytes);
}

#[test]
fn tiles_and_their_index_are_served_and_all_else_is_refused() {
    let scratch = scratch();
    build(&scratch, "--layer photo=texture:{}/photo.tif");
    let served = serve(&[scratch.path().join("store")]);
    let scene = Store::open(&scratch.path().join("store")).unwrap().scene().clone();
    let texture = &scene.textures[0];
    block(async {
        let asked = async |route: String| get(&format!("{}{route}", served.address)).await;
        let index = asked(message::index_route("world", &scene.version, "photo", 0)).await;
        let bytes = zstd::bulk::decompress(&index.body, coverage_bytes(texture)).unwrap();
        let coverage = Coverage::decode(texture, &bytes).unwrap();
        assert_eq!(coverage.tiles().count(), 1 + 4 + 9);
        for tile in coverage.tiles() {
            let answer = asked(message::tile_route("world", &scene.version, "photo", tile)).await;
            assert_eq!(answer.status.as_u16(), 200);
            assert_eq!(answer.header(&CONTENT_TYPE), "image/webp");
            assert!(answer.header(&ETAG).contains("x0"), "{}", answer.header(&ETAG));
            assert_eq!((&answer.body[..4], &answer.body[8..12]), (&b"RIFF"[..], &b"WEBP"[..]));
        }
        let at = |level, x, y| message::tile_route("world", &scene.version, "photo", Tile { level, x, y });
        let base = format!("/scenes/world/{}", scene.version);
        for route in [
            at(0, 1, 0),
            at(2, 3, 0),
            at(3, 0, 0),
            at(u32::MAX, 0, 0),
            at(2, 65_536, 0),
            format!("{base}/photo/texture/0/0/x"),
            format!("{base}/terrain/texture/0/0/0"),
            format!("{base}/photo/index/1"),
            format!("{base}/photo/points/3/3"),
            format!("{base}/photo/tin/index/0"),
        ] {
            let answer = asked(route.clone()).await;
            assert_eq!(answer.status.as_u16(), 404, "{route}");
            assert_eq!(answer.header(&CONTENT_TYPE), "application/problem+json");
        }
    });
    let picture = |options: &str| {
        client(
            scratch.path(),
            &format!("render {} --size 160x90 -o {{}}/a.png {options}", served.scene("world")),
        )
    };
    let drawn = picture("--json -");
    let report: serde_json::Value = serde_json::from_str(&drawn.out).unwrap();
    assert_eq!(
        (&report["texture"], report["texture_tiles"].as_u64() >= Some(1)),
        (&"photo".into(), true),
        "{report}"
    );
    assert_failed(&picture("--texture map"), 2, &["no texture 'map'", "it has photo"], "an unknown texture");
    assert_failed(&picture("--texture-light 2"), 2, &["--texture-light 2", "0 to 1"], "too much light");
    assert_eq!(picture("--texture none --json -").out.matches("\"texture\": null").count(), 1);
}

#[test]
fn tiles_that_were_kept_are_drawn_without_a_server() {
    let scratch = scratch();
    build(&scratch, "--layer photo=texture:{}/photo.tif");
    let served = serve(&[scratch.path().join("store")]);
    let url = served.scene("world");
    let picture = |name: &str, more: &str| {
        let command = format!(
            "render {url} --size 320x180 --no-antialias -o {{}}/{name}.png --json - --disk-cache {{}}/kept {more}"
        );
        let ended = client(scratch.path(), &command);
        assert_eq!(ended.code, Some(0), "{ended:?}");
        let report: serde_json::Value = serde_json::from_str(&ended.out).unwrap();
        (std::fs::read(scratch.path().join(name).with_extension("png")).unwrap(), report)
    };
    let (fetched, told) = picture("fetched", "");
    assert!(told["texture_tiles"].as_u64() >= Some(1), "{told}");
    drop(served);
    let (kept, offline) = picture("offline", "--offline");
    // While the ground was coarse, another tile may have been looked at for a moment.
    let tiles = [&offline, &told].map(|report| report["texture_tiles"].as_u64());
    assert!(Some(1) <= tiles[0] && tiles[0] <= tiles[1], "{tiles:?}");
    assert_eq!((&offline["offline"], &offline["requests"]), (&true.into(), &0.into()), "{offline}");
    assert!(kept == fetched, "other pictures");
    assert!(picture("bare", "--offline --texture none").0 != fetched, "no imagery in either");
}

#[test]
fn a_build_killed_while_tiles_are_made_is_gone_on_with() {
    let scratch = scratch();
    let options = "--layer photo=texture:{}/photo.tif --layer other=texture:{}/photo.png";
    build(&scratch, options);
    let whole = Store::open(&scratch.path().join("store")).unwrap().scene().version.clone();
    let command = format!(
        "build {{}}/dem.asc --assume-crs EPSG:32723 --scene world -o {{}}/again {options} --checkpoint 0"
    );
    for milliseconds in [60, 120, 200] {
        let mut child = start(&programs().server, &words(scratch.path(), &command));
        std::thread::sleep(Duration::from_millis(milliseconds));
        child.kill().unwrap();
        end(child);
    }
    let ended = server(scratch.path(), &command);
    assert_eq!(ended.code, Some(0), "{ended:?}");
    assert_eq!(Store::open(&scratch.path().join("again")).unwrap().scene().version, whole);
}

#[test]
fn pictures_that_are_none_or_lie_nowhere_are_refused_by_name() {
    let scratch = scratch();
    let file = |name: &str, bytes: &[u8]| std::fs::write(scratch.path().join(name), bytes).unwrap();
    std::fs::copy(scratch.path().join("photo.png"), scratch.path().join("nowhere.png")).unwrap();
    std::fs::copy(scratch.path().join("photo.png"), scratch.path().join("turned.png")).unwrap();
    file("turned.pgw", b"2 0.5 0.5 -2 400000 7500000");
    std::fs::copy(scratch.path().join("photo.png"), scratch.path().join("empty.png")).unwrap();
    file("empty.pgw", b"");
    let whole = std::fs::read(scratch.path().join("photo.png")).unwrap();
    file("cut.png", &whole[..whole.len() / 2]);
    file("text.jpg", b"no picture");
    file("short.jpg", b"\xff\xd8\xff\xe0 and no more");
    {
        let deep = File::create(scratch.path().join("deep.tif")).unwrap();
        let mut encoder = TiffEncoder::new(BufWriter::new(deep)).unwrap();
        encoder.write_image::<colortype::RGB16>(8, 8, &[7; 192]).unwrap();
    }
    for (argument, crs, words) in [
        ("photo=texture:{}/nowhere.png", "EPSG:32723", &["nowhere.png", "where it lies", ".pgw"][..]),
        ("photo=texture:{}/turned.png", "EPSG:32723", &["turned.pgw", "west to east"]),
        ("photo=texture:{}/empty.png", "EPSG:32723", &["empty.pgw", "six numbers"]),
        ("photo=texture:{}/cut.png", "EPSG:32723", &["cut.png", "whole PNG"]),
        ("photo=texture:{}/text.jpg", "EPSG:32723", &["text.jpg", "GeoTIFF, PNG or JPEG"]),
        ("photo=texture:{}/short.jpg", "EPSG:32723", &["short.jpg", "whole JPEG"]),
        ("photo=texture:{}/deep.tif", "EPSG:32723", &["deep.tif", "8 bits a band", "gdal_translate"]),
        ("photo=texture:{}/dem.asc", "EPSG:32723", &["dem.asc", "GeoTIFF, PNG or JPEG"]),
        ("photo=texture:{}/missing.tif", "EPSG:32723", &["missing.tif"]),
        ("terrain=texture:{}/photo.png", "EPSG:32723", &["'terrain' is terrain", "and texture"]),
    ] {
        let command = format!("build {{}}/dem.asc --assume-crs {crs} --layer {argument} -o {{}}/bad");
        let ended = server(scratch.path(), &command);
        assert!(matches!(ended.code, Some(1 | 2)), "{argument}: {ended:?}");
        assert_failed(&ended, ended.code.unwrap(), words, argument);
    }
    // A frame without a CRS cannot take a picture that has one.
    let ended = server(scratch.path(), "build {}/dem.asc --layer photo=texture:{}/photo.tif -o {}/bad");
    assert_failed(&ended, 2, &["photo.tif", "a layer without a CRS"], "no CRS");
    let ended = server(
        scratch.path(),
        "build {}/dem.asc --layer photo=texture:{}/photo.png --texture-quality 0 -o {}/bad",
    );
    assert_failed(&ended, 2, &["--texture-quality 0"], "no quality");
}

#[test]
fn a_flipped_bit_in_a_tile_is_found_and_nothing_wrong_is_drawn() {
    let scratch = scratch();
    build(&scratch, "--layer photo=texture:{}/photo.tif");
    let store = scratch.path().join("store");
    let version = Store::open(&store).unwrap().scene().version.clone();
    let pack = store.join(version).join("pack-00000");
    let mut bytes = std::fs::read(&pack).unwrap();
    // The last blobs are the finest tiles.
    let at = bytes.len() - 100;
    bytes[at] ^= 4;
    std::fs::write(&pack, bytes).unwrap();
    let ended = server(scratch.path(), "inspect {}/store --verify");
    assert_failed(&ended, 1, &["pack-00000", "Texture"], "a damaged tile");
    // The others are drawn, and that one is told of.
    let served = serve(&[store]);
    let target = DVec3::new(CORNER[0] + 1200.0, CORNER[1] + 1100.0, HEIGHT);
    let eye = target + DVec3::new(0.0, -1.0, 250.0);
    let point = |p: DVec3| format!("{},{},{}", p.x, p.y, p.z);
    let command = format!(
        "render {} --size 300x200 -o {{}}/a.png --timeout 60 --eye {} --target {}",
        served.scene("world"),
        point(eye),
        point(target)
    );
    let ended = client(scratch.path(), &command);
    assert_eq!(ended.code, Some(1), "{ended:?}");
    assert!(ended.err.contains("/photo/texture/2/"), "{ended:?}");
    assert!(scratch.path().join("a.png").exists());
}
