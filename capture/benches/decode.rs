//! Decoding: the JPEG and PNG sizes of 7-Scenes and KITTI.
//!
//! Real frames where they are at hand (`GRNET_DATA` or `../shared/data`), else a made image of the same size.

use std::io::Cursor;
use std::path::{Path, PathBuf};

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use grnet_capture::decode::decode_bytes;
use image::{DynamicImage, GrayImage, ImageFormat, Luma, Rgb, RgbImage};

fn data(name: &str) -> Option<Vec<u8>> {
    let beside = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data");
    let folder = std::env::var_os("GRNET_DATA").map_or_else(beside, PathBuf::from);
    std::fs::read(folder.join(name)).ok()
}

/// Shading with fine texture, which compresses about as photographs do.
fn level(x: u32, y: u32) -> u8 {
    let texture = x.wrapping_mul(2_654_435_761).wrapping_add(y.wrapping_mul(40_503)) >> 28;
    (x / 8 + y / 4) as u8 ^ texture as u8
}

fn encoded(image: &DynamicImage, format: ImageFormat) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    image.write_to(&mut bytes, format).expect("an image in memory can be encoded");
    bytes.into_inner()
}

fn decode(criterion: &mut Criterion) {
    let jpeg = || {
        let image = RgbImage::from_fn(640, 480, |x, y| Rgb([level(x, y), level(y, x), 128]));
        encoded(&image.into(), ImageFormat::Jpeg)
    };
    let png = || {
        let image = GrayImage::from_fn(1241, 376, |x, y| Luma([level(x, y)]));
        encoded(&image.into(), ImageFormat::Png)
    };
    let mut group = criterion.benchmark_group("decode");
    for (name, real, made) in [
        ("jpeg 640x480 colour", data("redkitchen/seq-01/frame-000000.color.jpg"), jpeg()),
        ("png 1241x376 grey", data("kitti/sequences/00/image_0/000000.png"), png()),
    ] {
        let (origin, bytes) = real.map_or(("made", made), |bytes| ("recorded", bytes));
        group.throughput(Throughput::Elements(1));
        group.bench_function(format!("{name}, {origin}, {} kB", bytes.len() / 1000), |bencher| {
            bencher.iter(|| decode_bytes(&bytes).expect("the image is good"));
        });
    }
    group.finish();
}

criterion_group!(benches, decode);
criterion_main!(benches);
