use super::*;

fn read_all(
    bytes: &[u8],
    n: u64,
    number: Number,
    endian: Endian,
) -> Result<(Samples, ValueMap), Problem> {
    let layout = Layout::new([n, 1, 1], number, endian, "sizes")?;
    read(&mut &bytes[..], Supply::Plain { have: bytes.len() as u64 }, &layout, ByteCap::default())
}

fn values((samples, map): &(Samples, ValueMap)) -> Vec<f64> {
    (0..samples.len()).map(|i| map.value(samples.code(i))).collect()
}

/// A stream whose decoder panics after the given number of bytes.
struct Panics(usize);

impl Read for Panics {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        assert!(self.0 > 0, "injected into the decoder");
        let n = buffer.len().min(self.0);
        self.0 -= n;
        Ok(n)
    }
}

#[test]
fn panic_in_the_decompressing_thread_fails_the_file() {
    let need = 4 * THREAD_MIN_BYTES;
    let layout = Layout::new([1024, need / 1024, 1], Number::U8, Endian::Little, "sizes").unwrap();
    let supply = Supply::Encoded { name: "gzip", bytes: need, ratio: 64 };
    let error = read(&mut Panics(need as usize / 2), supply, &layout, ByteCap::default())
        .expect_err("it panics");
    assert_eq!((error.kind, &error.field[..]), (OpenErrorKind::Unsupported, "data"));
    assert!(error.what.contains("panicked (injected into the decoder)"), "{error}");
}

macro_rules! both_orders {
    ($number:expr, $numbers:expr, $kind:pat) => {
        let numbers = $numbers;
        let n = numbers.len() as u64;
        let le: Vec<u8> = numbers.iter().flat_map(|x| x.to_le_bytes()).collect();
        let be: Vec<u8> = numbers.iter().flat_map(|x| x.to_be_bytes()).collect();
        let a = read_all(&le, n, $number, Endian::Little).unwrap();
        assert_eq!(a, read_all(&be, n, $number, Endian::Big).unwrap());
        assert!(matches!(a.0, $kind), "{:?} became {:?}", $number, a.0);
        let want: Vec<f64> = numbers.iter().map(|&x| x as f64).collect();
        let span = want.iter().fold(0.0f64, |a, &b| a.max(b)) - want[0];
        for (got, want) in values(&a).iter().zip(&want) {
            assert!((got - want).abs() <= span.abs() * 1e-7, "{got} against {want}");
        }
    };
}

#[test]
fn sample_types_keep_their_values_in_both_byte_orders() {
    both_orders!(Number::U8, [0u8, 7, 255], Samples::U8(_));
    both_orders!(Number::I8, [-128i8, -1, 0, 127], Samples::U8(_));
    both_orders!(Number::U16, [0u16, 258, 65535], Samples::U16(_));
    both_orders!(Number::I16, [-32768i16, -1, 0, 1, 32767], Samples::U16(_));
    both_orders!(Number::U32, [4_000_000_000u32, 4_000_065_535], Samples::U16(_));
    both_orders!(Number::U32, [0u32, 5, u32::MAX], Samples::F32(_));
    both_orders!(Number::I32, [-70000i32, -4465], Samples::U16(_));
    both_orders!(Number::I32, [i32::MIN, 0, i32::MAX], Samples::F32(_));
    both_orders!(Number::U64, [0u64, 1 << 40, u64::MAX], Samples::F32(_));
    both_orders!(Number::I64, [i64::MIN, 0, i64::MAX], Samples::F32(_));
    both_orders!(Number::I64, [-3i64, 4], Samples::U16(_));
    both_orders!(Number::F32, [-1.5f32, 1e-40, 3e38], Samples::F32(_));
    both_orders!(Number::F64, [-1.5f64, 0.25, 1e30], Samples::F32(_));
}

#[test]
fn float64_beyond_f32_is_rescaled_and_nan_and_infinity_stay() {
    let inf = f64::INFINITY;
    for (numbers, mapped) in [
        (vec![-1.7e308, 0.0, 1.7e308, f64::NAN, inf, -inf], true),
        (vec![1e300, 2e300, 3e300], true),
        (vec![1e-300, 2e-300, 3e-300], true),
        (vec![5e-324, 1e-323], true),
        (vec![1e9, 1e9 + 1.0, 1e9 + 2.0], true),
        (vec![1e300; 3], true),
        (vec![0.5; 3], false),
        (vec![f64::NAN; 3], false),
        (vec![0.0, 1.0, f64::NAN, inf], false),
    ] {
        let bytes: Vec<u8> = numbers.iter().flat_map(|x| x.to_le_bytes()).collect();
        let got = read_all(&bytes, numbers.len() as u64, Number::F64, Endian::Little).unwrap();
        assert_eq!(got.1 != ValueMap::IDENTITY, mapped, "{numbers:?} gave {:?}", got.1);
        assert!(got.1.scale.is_finite() && got.1.offset.is_finite() && got.1.scale != 0.0);
        let finite = numbers.iter().filter(|v| v.is_finite());
        let lo = finite.clone().copied().fold(inf, f64::min);
        let hi = finite.copied().fold(-inf, f64::max);
        for (v, want) in values(&got).iter().zip(&numbers) {
            if want.is_finite() {
                let off = (v / 2.0 - want / 2.0).abs();
                assert!(off <= (hi / 2.0 - lo / 2.0) * 1e-4, "{v:e} against {want:e}");
            } else {
                assert!(v == want || v.is_nan() && want.is_nan(), "{v} against {want}");
            }
        }
    }
}

#[test]
fn one_filler_does_not_take_the_values_of_the_others() {
    for (filler, number) in [
        (1e300, Number::F64),
        (-f64::MAX, Number::F64),
        (1e30, Number::F64),
        (-3e38, Number::F32),
        (1e20, Number::F32),
    ] {
        let numbers = [&[0.0, filler, 1000.0, 250.0, -filler][..], &[7.0; 60]].concat();
        let bytes: Vec<u8> = match number {
            Number::F32 => numbers.iter().flat_map(|x| (*x as f32).to_le_bytes()).collect(),
            _ => numbers.iter().flat_map(|x| x.to_le_bytes()).collect(),
        };
        let got = read_all(&bytes, 65, number, Endian::Little).unwrap();
        let v = values(&got);
        assert_eq!([v[0], v[2], v[3]], [0.0, 1000.0, 250.0]);
        assert!(v[1].is_nan() && v[4].is_nan(), "{v:?}");
    }
    // A hot voxel, a mask, a point in noise, and numbers that are large.
    for numbers in [[0.0f32, 1.0, 1e12], [0.0, 0.0, 1e30], [1e-17, 2e-17, 1.0], [1e20, 2e20, 3e28]]
    {
        let numbers = [&numbers[..], &[numbers[0]; 62]].concat();
        let bytes: Vec<u8> = numbers.iter().flat_map(|x| x.to_le_bytes()).collect();
        let got = read_all(&bytes, 65, Number::F32, Endian::Little).unwrap();
        assert_eq!(got.0, Samples::F32(numbers));
    }
}

#[test]
fn oversized_dimensions_are_refused_before_memory_is_taken() {
    for dims in [[0, 1, 1], [16385, 1, 1], [16384, 16384, 16384], [u64::MAX; 3]] {
        assert!(Layout::new(dims, Number::F64, Endian::Little, "sizes").is_err(), "{dims:?}");
    }
    let e = read_all(&[0; 7], 4, Number::U16, Endian::Little).unwrap_err().to_string();
    assert!(e.contains("8 bytes are needed and 7 are there"), "{e}");
}
