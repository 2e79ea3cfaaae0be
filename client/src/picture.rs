//! A picture in memory, and as a PNG file.

use std::io::Write;

/// Rows of pixels from the top, each red, green, blue, alpha, sRGB.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Picture {
    /// Width and height, in pixels.
    pub size: [u32; 2],
    /// `4 * width * height` bytes.
    pub pixels: Vec<u8>,
}

impl Picture {
    /// The pixel in column `x` from the left and row `y` from the top; `None` outside.
    #[must_use]
    pub fn pixel(&self, [x, y]: [u32; 2]) -> Option<[u8; 4]> {
        let [width, height] = self.size;
        if x >= width || y >= height {
            return None;
        }
        let at = 4 * (y as usize * width as usize + x as usize);
        self.pixels.get(at..at + 4)?.try_into().ok()
    }
}

/// Writes a picture as PNG, compressed for speed: some milliseconds a megapixel instead of hundreds.
///
/// # Errors
/// When `out` fails, or the picture has not as many pixels as its size says.
pub fn write_png(picture: &Picture, out: impl Write) -> Result<(), png::EncodingError> {
    let mut encoder = png::Encoder::new(out, picture.size[0], picture.size[1]);
    encoder.set_color(png::ColorType::Rgba);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::Fast);
    encoder.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(&picture.pixels)?;
    writer.finish()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_png_comes_back() {
        let pixels = (0..4 * 7 * 5).map(|i| u8::try_from(i).unwrap()).collect();
        let picture = Picture { size: [7, 5], pixels };
        let mut bytes = Vec::new();
        write_png(&picture, &mut bytes).unwrap();
        let mut reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info().unwrap();
        let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
        let info = reader.next_frame(&mut pixels).unwrap();
        assert_eq!(([info.width, info.height], &pixels), ([7, 5], &picture.pixels));
    }

    #[test]
    fn pixels_are_found_by_column_and_row() {
        let picture = Picture { size: [2, 2], pixels: (0..16).collect() };
        assert_eq!(picture.pixel([1, 0]), Some([4, 5, 6, 7]));
        assert_eq!(picture.pixel([0, 1]), Some([8, 9, 10, 11]));
        assert_eq!(picture.pixel([2, 0]), None);
    }
}
