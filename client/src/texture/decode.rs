//! Pictures of tiles → texels, beside the frames.
//!
//! Natively in Rust, on threads of its own; in a browser by the browser, which does it on its own threads and has the
//! program for it already.

use super::coding::{Coding, blocks};
use crate::background::Background;
use bytes::Bytes;
use diamantina_protocol::texture::{self, SIDE, Tile};
use std::sync::mpsc;

/// The texels of a tile: red, green, blue and opacity, rows from the north, sRGB; colours are multiplied by the opacity, as
/// light, so that the texels' mean is that of what they show.
#[derive(Debug, PartialEq, Eq)]
pub struct TileImage {
    texels: Vec<u8>,
    coding: Coding,
}

impl TileImage {
    /// Texels as they are in pictures: as many as a tile has.
    ///
    /// # Errors
    /// When there are more or fewer, in words.
    pub fn new(mut texels: Vec<u8>) -> Result<Self, String> {
        let expected = Coding::Plain.tile_bytes();
        if texels.len() != expected {
            return Err(format!("{} bytes of texels, expected {expected}", texels.len()));
        }
        texels.as_chunks_mut::<4>().0.iter_mut().for_each(multiply);
        Ok(Self { texels, coding: Coding::Plain })
    }

    /// The same picture in another coding. To blocks and back is not the same again.
    #[must_use]
    pub fn coded(self, coding: Coding) -> Self {
        let texels = match (self.coding, coding) {
            (Coding::Plain, Coding::Blocks) => blocks(&self.texels),
            (Coding::Blocks, Coding::Plain) => super::coding::plain(&self.texels),
            _ => self.texels,
        };
        Self { texels, coding }
    }

    /// How the texels are coded.
    #[must_use]
    pub fn coding(&self) -> Coding {
        self.coding
    }

    /// The bytes of the texels.
    #[must_use]
    pub fn texels(&self) -> &[u8] {
        &self.texels
    }
}

/// Multiplies a colour by its opacity, as light.
fn multiply(texel: &mut [u8; 4]) {
    let opacity = texel[3];
    if opacity == u8::MAX {
        return;
    }
    if opacity == 0 {
        *texel = [0; 4];
        return;
    }
    for colour in &mut texel[..3] {
        let less = texture::light(f64::from(*colour) / 255.0) * f64::from(opacity) / 255.0;
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "from 0 to 255")]
        let byte = (texture::srgb(less) * 255.0).round() as u8;
        *colour = byte;
    }
}

type Decoded = (Tile, Result<TileImage, String>);

/// Decodes in the background.
#[derive(Debug)]
pub(super) struct Decoder {
    coding: Coding,
    background: Background,
    sender: mpsc::Sender<Decoded>,
    decoded: mpsc::Receiver<Decoded>,
}

impl Decoder {
    /// Gives pictures in this coding.
    pub(super) fn start(coding: Coding) -> std::io::Result<Self> {
        let (sender, decoded) = mpsc::channel();
        Ok(Self { coding, background: Background::start("diamantina-tiles")?, sender, decoded })
    }

    pub(super) fn submit(&self, tile: Tile, picture: Bytes) {
        let (sender, coding) = (self.sender.clone(), self.coding);
        self.background.spawn(async move {
            let image = driver::texels(&picture).await.and_then(TileImage::new);
            let image = image.map(|image| image.coded(coding));
            // Nobody waits for it any more when the texture is dropped.
            let _ = sender.send((tile, image));
        });
    }

    pub(super) fn poll(&self) -> Option<Decoded> {
        self.decoded.try_recv().ok()
    }
}

#[cfg(not(target_arch = "wasm32"))]
mod driver {
    use super::SIDE;

    /// Red, green, blue and opacity of a picture of a tile's size, which may be hostile.
    #[allow(clippy::unused_async, reason = "the browser's is")]
    pub(super) async fn texels(picture: &[u8]) -> Result<Vec<u8>, String> {
        let mut decoder =
            image_webp::WebPDecoder::new(std::io::Cursor::new(picture)).map_err(|e| e.to_string())?;
        if decoder.dimensions() != (SIDE, SIDE) || decoder.is_animated() {
            let (width, height) = decoder.dimensions();
            return Err(format!("{width} x {height} texels, expected {SIDE} x {SIDE}"));
        }
        decoder.set_memory_limit(16 << 20);
        let bytes = decoder.output_buffer_size().ok_or("too many texels")?;
        let mut texels = vec![0; bytes];
        decoder.read_image(&mut texels).map_err(|e| e.to_string())?;
        if decoder.has_alpha() {
            return Ok(texels);
        }
        let (colours, _) = texels.as_chunks::<3>();
        Ok(colours.iter().flat_map(|[r, g, b]| [*r, *g, *b, u8::MAX]).collect())
    }
}

#[cfg(target_arch = "wasm32")]
mod driver {
    use super::SIDE;
    use wasm_bindgen::JsCast;
    use wasm_bindgen_futures::JsFuture;
    use web_sys::{Blob, BlobPropertyBag, ImageBitmap, OffscreenCanvas, OffscreenCanvasRenderingContext2d};

    /// Red, green, blue and opacity of a picture of a tile's size, which may be hostile.
    pub(super) async fn texels(picture: &[u8]) -> Result<Vec<u8>, String> {
        draw(picture).await.map_err(|error| format!("{error:?}"))
    }

    async fn draw(picture: &[u8]) -> Result<Vec<u8>, wasm_bindgen::JsValue> {
        let parts = js_sys::Array::of1(&js_sys::Uint8Array::from(picture));
        let kind = BlobPropertyBag::new();
        kind.set_type("image/webp");
        let blob = Blob::new_with_u8_array_sequence_and_options(&parts, &kind)?;
        let window = js_sys::global().unchecked_into::<web_sys::Window>();
        let bitmap: ImageBitmap =
            JsFuture::from(window.create_image_bitmap_with_blob(&blob)?).await?.dyn_into()?;
        if [bitmap.width(), bitmap.height()] != [SIDE; 2] {
            return Err("a picture of another size".into());
        }
        let canvas = OffscreenCanvas::new(SIDE, SIDE)?;
        let context: OffscreenCanvasRenderingContext2d =
            canvas.get_context("2d")?.ok_or("no canvas to draw on")?.dyn_into()?;
        context.draw_image_with_image_bitmap(&bitmap, 0.0, 0.0)?;
        bitmap.close();
        let data = context.get_image_data(0.0, 0.0, f64::from(SIDE), f64::from(SIDE))?;
        Ok(data.data().0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_tile_is_refused() {
        let decode = |bytes: &[u8]| pollster::block_on(driver::texels(bytes));
        assert!(decode(b"").is_err());
        assert!(decode(b"RIFF\x04\x00\x00\x00WEBP").is_err());
        let picture = |side: u32| {
            let mut bytes = Vec::new();
            let texels: Vec<u8> = (0..4 * side * side).map(|i| (i * 7 % 251) as u8).collect();
            let encoder = image_webp::WebPEncoder::new(&mut bytes);
            encoder.encode(&texels, side, side, image_webp::ColorType::Rgba8).unwrap();
            (bytes, texels)
        };
        let (bytes, texels) = picture(SIDE);
        assert_eq!(decode(&bytes).unwrap(), texels);
        assert!(decode(&bytes[..bytes.len() / 2]).is_err());
        assert!(decode(&picture(SIDE / 2).0).is_err());
        assert!(TileImage::new(vec![0; 100]).is_err());
    }

    #[test]
    fn colours_are_multiplied_as_light() {
        let mut texel = [255, 188, 0, 128];
        multiply(&mut texel);
        // Half the light of white is 188; half of that 138.
        assert_eq!(texel, [188, 138, 0, 128]);
        for (opacity, expected) in [(0, [0; 4]), (255, [9, 8, 7, 255])] {
            let mut texel = [9, 8, 7, opacity];
            multiply(&mut texel);
            assert_eq!(texel, expected);
        }
    }
}
